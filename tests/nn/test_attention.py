"""Attention against torch's scaled_dot_product_attention and nn.MultiheadAttention."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.nn.attention import Attention, _mix, attention, cross_attention
from crisalad_jax.nn.layers import init_linear

TOKENS, DIM, HEADS = 7, 12, 3


def make() -> tuple[Attention, jax.Array, torch.nn.MultiheadAttention]:
    qkv, proj, data = jax.random.split(jax.random.key(0), 3)
    params = Attention(init_linear(qkv, DIM, 3 * DIM), init_linear(proj, DIM, DIM))
    theirs = torch.nn.MultiheadAttention(DIM, HEADS, batch_first=True)
    with torch.no_grad():
        for target, source in (
            (theirs.in_proj_weight, params.qkv.weight.T),
            (theirs.in_proj_bias, params.qkv.bias),
            (theirs.out_proj.weight, params.proj.weight.T),
            (theirs.out_proj.bias, params.proj.bias),
        ):
            target.copy_(torch.tensor(np.asarray(source)))
    return params, jax.random.normal(data, (TOKENS, DIM)), theirs


def test_equals_torch_with_and_without_mask() -> None:
    params, x, theirs = make()
    x = jnp.stack([x, 1 - x])
    mask = np.random.default_rng(0).random((TOKENS, TOKENS)) < 0.5
    np.fill_diagonal(mask, True)
    tx = torch.tensor(np.asarray(x))
    for allowed in (None, mask):
        forbidden = None if allowed is None else torch.tensor(~allowed)
        expected = theirs(tx, tx, tx, attn_mask=forbidden, need_weights=False)[0]
        seen = None if allowed is None else jnp.asarray(allowed)
        ours = attention(params, x, HEADS, mask=seen, key=None)
        one = attention(params, x[1], HEADS, mask=seen, key=None)
        # Two products of 12 terms of order 1 in float32.
        np.testing.assert_allclose(ours, expected.detach().numpy(), atol=2e-6)
        np.testing.assert_allclose(one, expected[1].detach().numpy(), atol=2e-6)


def test_queries_of_their_own_are_torchs_cross_attention() -> None:
    params, x, theirs = make()
    tokens, queries = jnp.stack([x, 1 - x, 2 * x]), x[:4] + 0.5

    def found(params: Attention, queries: jax.Array, tokens: jax.Array) -> jax.Array:
        return cross_attention(params, queries, tokens, HEADS)

    asked = torch.tensor(np.asarray(queries), requires_grad=True)
    seen = torch.tensor(np.asarray(tokens), requires_grad=True)
    expected = theirs(asked.expand(3, -1, -1), seen, seen, need_weights=False)[0]
    ours, back = jax.vjp(found, params, queries, tokens)
    assert ours.shape == (3, 4, DIM)
    np.testing.assert_allclose(ours, expected.detach(), atol=2e-6)
    one = cross_attention(params, queries, tokens[2], HEADS)
    np.testing.assert_allclose(one, expected[2].detach(), atol=2e-6)

    slope = np.random.default_rng(0).normal(size=ours.shape).astype(np.float32)
    expected.backward(torch.tensor(slope))
    to_params, to_queries, to_tokens = back(jnp.asarray(slope))
    for mine, other in (
        (to_queries, asked.grad),
        (to_tokens, seen.grad),
        (to_params.qkv.weight.T, theirs.in_proj_weight.grad),
        (to_params.qkv.bias, theirs.in_proj_bias.grad),
    ):
        # Sums of some hundred products of order 1.
        np.testing.assert_allclose(mine, other, atol=2e-5)


def test_a_masked_token_has_no_influence_and_no_gradient() -> None:
    params, x, _ = make()
    mask = jnp.ones((TOKENS, TOKENS), bool).at[:-1, -1].set(False)

    def seen(x: jax.Array) -> jax.Array:
        return attention(params, x, HEADS, mask=mask, key=None)[:-1]

    np.testing.assert_array_equal(seen(x), seen(x.at[-1].set(1e6)))
    gradient = jax.grad(lambda x: jnp.sin(seen(x)).sum())(x)
    np.testing.assert_array_equal(gradient[-1], 0)
    assert jnp.abs(gradient[:-1]).max() > 0


@pytest.mark.parametrize("masked", [False, True], ids=["all", "masked"])
@pytest.mark.parametrize("dropping", [False, True], ids=["whole", "dropped"])
def test_gradient_equals_that_of_torchs_softmax(masked: bool, dropping: bool) -> None:
    generator = np.random.default_rng(0)
    queries, change = generator.normal(size=(2, HEADS, DIM, TOKENS)).astype(np.float32)
    keys, values = generator.normal(size=(2, HEADS, TOKENS, DIM)).astype(np.float32)
    mask = generator.random((TOKENS, TOKENS)) < 0.5 if masked else None  # keys by queries
    if mask is not None:
        np.fill_diagonal(mask, True)
    shape = (HEADS, TOKENS, TOKENS)
    kept = 2.0 * (generator.random(shape) < 0.5).astype(np.float32) if dropping else None

    def ours(queries: jax.Array, keys: jax.Array, values: jax.Array) -> jax.Array:
        return (
            _mix(queries, keys, values, *jax.tree.map(jnp.asarray, (mask, kept))) * change
        ).sum()

    found, gradients = jax.value_and_grad(ours, argnums=(0, 1, 2))(
        *map(jnp.asarray, (queries, keys, values))
    )
    theirs = [torch.tensor(x, requires_grad=True) for x in (queries, keys, values)]
    scores = theirs[1] @ theirs[0]
    if mask is not None:
        scores = scores.masked_fill(~torch.tensor(mask), -torch.inf)
    weights = scores.softmax(dim=1) * (1 if kept is None else torch.tensor(kept))
    expected = ((theirs[2].mT @ weights) * torch.tensor(change)).sum()
    expected.backward()
    # Sums of a few hundred numbers of order 1 in float32, and scores of order 10.
    np.testing.assert_allclose(found, expected.item(), rtol=1e-4)
    for gradient, tensor in zip(gradients, theirs, strict=True):
        np.testing.assert_allclose(gradient, tensor.grad, atol=1e-4)


def test_scores_of_bfloat16_are_float32() -> None:
    params, x, _ = make()
    ours = attention(params, x.astype(jnp.bfloat16), HEADS, key=None)
    assert ours.dtype == jnp.bfloat16
    # bfloat16 keeps 8 bits: inputs, weights and outputs of order 1 are each off by up to 2^-9.
    np.testing.assert_allclose(
        np.asarray(ours, np.float32), attention(params, x, HEADS, key=None), atol=0.02
    )


def test_dropout_needs_a_key_and_changes_the_output() -> None:
    params, x, _ = make()
    plain = attention(params, x, HEADS, dropout_rate=0.5, key=None)
    np.testing.assert_array_equal(plain, attention(params, x, HEADS, key=None))
    dropped = attention(params, x, HEADS, dropout_rate=0.5, key=jax.random.key(1))
    assert not np.allclose(plain, dropped, atol=1e-3)


@pytest.mark.slow
def test_cudnn_is_asked_where_it_can_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """With XLA in its place, which takes the same arguments: here there is no GPU."""
    x = jax.random.normal(jax.random.key(0), (3, TOKENS, 16)).astype(jnp.bfloat16)
    params = Attention(*(init_linear(jax.random.key(n), 16, 16 * n) for n in (3, 1)))

    def value(x: jax.Array) -> jax.Array:
        return jnp.sin(attention(params, x, 2, key=None).astype(jnp.float32)).sum()

    expected, gradient = attention(params, x, 2, key=None), jax.grad(value)(x)
    asked = []

    def stand_in(*args: jax.Array, implementation: str) -> jax.Array:
        asked.append(implementation)
        return original(*args, implementation="xla")

    original = jax.nn.dot_product_attention
    monkeypatch.setattr(jax.nn, "dot_product_attention", stand_in)
    monkeypatch.setattr("crisalad_jax.nn.attention.has_fused_attention", lambda: True)
    found = attention(params, x, 2, key=None)
    assert asked == ["cudnn"]
    # bfloat16 keeps 8 bits, and the two divide at different places.
    np.testing.assert_allclose(found.astype(jnp.float32), expected.astype(jnp.float32), atol=0.02)
    found = jax.grad(value)(x)
    assert asked == 2 * ["cudnn"]
    np.testing.assert_allclose(found.astype(jnp.float32), gradient.astype(jnp.float32), atol=0.02)
    attention(params, x, 4, key=None)  # heads of 4 numbers: cuDNN takes eights
    attention(params, x, 2, mask=jnp.ones((TOKENS, TOKENS), bool), key=None)
    attention(params, x.astype(jnp.float32), 2, key=None)
    attention(params, x, 2, dropout_rate=0.5, key=jax.random.key(0))
    assert asked == 2 * ["cudnn"]
