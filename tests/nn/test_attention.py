"""Attention's masks and gradients against torch's softmax, and its kernels against the CPU's.

parity/ compares self- and cross-attention with torch's modules.
"""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.nn import attention as attention_module
from crisalad_jax.nn import attention_pallas
from crisalad_jax.nn.attention import (
    Attention,
    Rotation,
    attention,
    cross_attention,
    dot_product_attention,
)
from crisalad_jax.nn.attention_fused import padded_length
from crisalad_jax.nn.layers import init_linear, linear
from crisalad_jax.utils.target import CPU, GPU, TPU, Target, lowering_for
from tests.nn.conftest import slow_unless

TOKENS, DIM, HEADS = 7, 12, 3


def network(dim: int) -> Attention:
    qkv, proj = jax.random.split(jax.random.key(2))
    return Attention(init_linear(qkv, dim, 3 * dim), init_linear(proj, dim, dim))


def make() -> tuple[Attention, jax.Array]:
    return network(DIM), jax.random.normal(jax.random.key(0), (TOKENS, DIM))


def masked_attention(params: Attention, x: jax.Array, mask: Any, dropped: Any = None) -> jax.Array:
    qkv = linear(params.qkv, x).reshape(*x.shape[:-1], 3 * HEADS, DIM // HEADS)
    parts = jnp.split(qkv, 3, axis=-2)
    mixed = dot_product_attention(*parts, mask=mask, dropout_mask=dropped)
    return linear(params.proj, mixed.reshape(x.shape))


def test_a_masked_token_has_no_influence_and_no_gradient() -> None:
    params, x = make()
    mask = jnp.ones((TOKENS, TOKENS), bool).at[:-1, -1].set(False)

    def seen(x: jax.Array) -> jax.Array:
        return masked_attention(params, x, mask)[:-1]

    np.testing.assert_array_equal(seen(x), seen(x.at[-1].set(1e6)))
    gradient = jax.grad(lambda x: jnp.sin(seen(x)).sum())(x)
    np.testing.assert_array_equal(gradient[-1], 0)
    assert jnp.abs(gradient[:-1]).max() > 0


@pytest.mark.parametrize("masking", [False, True], ids=["whole", "masked and dropped"])
def test_gradient_equals_that_of_torchs_softmax(masking: bool) -> None:
    generator = np.random.default_rng(0)
    shape = (4, TOKENS, HEADS, DIM)
    queries, keys, values, change = generator.normal(size=shape).astype(np.float32)
    mask = generator.random((TOKENS, TOKENS)) < 0.5  # queries by keys
    np.fill_diagonal(mask, True)
    shape = (HEADS, TOKENS, TOKENS)  # heads, keys, queries
    kept = 2.0 * (generator.random(shape) < 0.5).astype(np.float32)
    masks = {"mask": jnp.asarray(mask), "dropout_mask": jnp.asarray(kept)} if masking else {}

    def ours(queries: jax.Array, keys: jax.Array, values: jax.Array) -> jax.Array:
        return (dot_product_attention(queries, keys, values, **masks) * change).sum()

    found, gradients = jax.value_and_grad(ours, argnums=(0, 1, 2))(
        *map(jnp.asarray, (queries, keys, values))
    )
    theirs = [torch.tensor(x, requires_grad=True) for x in (queries, keys, values)]
    scores = torch.einsum("ihd,jhd->hij", theirs[0], theirs[1]) / DIM**0.5
    if masking:
        scores = scores.masked_fill(~torch.tensor(mask), -torch.inf)
    weights = scores.softmax(dim=2) * (torch.tensor(kept).mT if masking else 1)
    mixed = torch.einsum("hij,jhd->ihd", weights, theirs[2])
    expected = (mixed * torch.tensor(change)).sum()
    expected.backward()
    # Sums of a few hundred numbers of order 1 in float32, and scores of order 10.
    np.testing.assert_allclose(found, expected.item(), rtol=1e-4)
    for gradient, tensor in zip(gradients, theirs, strict=True):
        np.testing.assert_allclose(gradient, tensor.grad, atol=1e-4)


def test_scores_of_bfloat16_are_float32() -> None:
    params, x = make()
    ours = attention(params, x.astype(jnp.bfloat16), HEADS)
    assert ours.dtype == jnp.bfloat16
    # bfloat16 keeps 8 bits: inputs, weights and outputs of order 1 are each off by up to 2^-9.
    np.testing.assert_allclose(np.asarray(ours, np.float32), attention(params, x, HEADS), atol=0.02)


def sample(tokens: int, dim: int, batch: int = 2) -> jax.Array:
    return jax.random.normal(jax.random.key(3), (batch, tokens, dim))


def angles(patches: int, head: int) -> Rotation:
    turns = np.random.default_rng(4).uniform(-3, 3, (patches, head // 2))
    return Rotation(np.cos(turns), np.sin(turns))


def with_gradient(x: jax.Array, heads: int, **options: Any) -> tuple[jax.Array, Any]:
    """The output, and the gradient of a number of it by parameters and tokens."""
    params = network(x.shape[-1])

    def value(params: Attention, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        y = attention(params, x, heads, **options)
        return jnp.sin(3 * y.astype(jnp.float32)).sum(), y

    gradient, y = jax.jit(jax.grad(value, argnums=(0, 1), has_aux=True))(params, x)
    return y, gradient


def assert_slopes_agree(found: Any, expected: Any, share: float) -> None:
    """To a share of the largest number of each array."""
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        ours, theirs = (np.asarray(each, np.float32) for each in (ours, theirs))
        np.testing.assert_allclose(ours, theirs, atol=share * np.abs(theirs).max())


@pytest.mark.parametrize(
    ("tokens", "dim", "heads"),
    [
        (261, 128, 4),  # 224 x 224 and four registers; heads of 32
        (530, 128, 2),  # 322 x 322, whose queries are cut in two
        pytest.param(*(50, 256, 2), marks=pytest.mark.slow),  # heads of 128
        # More heads than a step of the kernel takes.
        pytest.param(*(7, 1024, 16), marks=pytest.mark.slow),
    ],
)
def test_a_tpus_kernel_is_the_cpus_attention(
    interpreted: list[Any], tokens: int, dim: int, heads: int
) -> None:
    x = sample(tokens, dim, batch=1)
    expected, slopes = with_gradient(x, heads)
    with lowering_for(TPU):
        found, gradients = with_gradient(x, heads)
    assert len(interpreted) == 2
    # Averages of values of order 1 in float32; the issue asks for 1e-6.
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert_slopes_agree(gradients, slopes, 1e-5)  # sums over some hundred tokens


def test_a_tpus_kernel_takes_rotated_heads_and_bfloat16(interpreted: list[Any]) -> None:
    x = sample(53, 128)
    expected, slopes = with_gradient(x, 2, rotation=angles(48, 64))
    with lowering_for(TPU):
        found, gradients = with_gradient(x, 2, rotation=angles(48, 64))
        half, halves = with_gradient(x.astype(jnp.bfloat16), 2, rotation=angles(48, 64))
    assert len(interpreted) == 4
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert_slopes_agree(gradients, slopes, 1e-5)
    assert half.dtype == jnp.bfloat16
    # bfloat16 keeps 8 bits: inputs, weights and outputs of order 1 are each off by up to 2^-9.
    np.testing.assert_allclose(half.astype(jnp.float32), expected, atol=0.02)
    # The same numbers of 8 bits, twice: of the forward pass and of the gradient.
    assert_slopes_agree(halves, slopes, 0.03)


def kernels(jaxpr: Any) -> Iterator[Any]:
    """Find the kernels of a program, and of those that it calls."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "pallas_call":
            yield equation.params["jaxpr"]
        for value in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda each: hasattr(each, "eqns")
        ):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns") and equation.primitive.name != "pallas_call":
                yield from kernels(inner)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_a_tpus_kernel_multiplies_in_float32_and_sums_in_it(dtype: str) -> None:
    """Interpret mode computes in float32 whatever is asked for: what is asked for is read here."""
    x = sample(420, 128).astype(dtype)  # rows of more than one chunk
    # As `ModelConfig.precision` has it.
    with lowering_for(TPU), jax.default_matmul_precision("highest"):
        program = jax.make_jaxpr(lambda x: with_gradient(x, 2))(x)
    found = list(kernels(program.jaxpr))
    assert len(found) == 2  # forward, and the gradient
    precision = jax.lax.Precision.HIGHEST if dtype == "float32" else jax.lax.Precision.DEFAULT
    for kernel in found:
        products = [each for each in kernel.eqns if each.primitive.name == "dot_general"]
        assert len(products) >= 4
        for product in products:
            assert set(product.params["precision"]) == {precision}
            assert product.params["preferred_element_type"] == jnp.float32
            assert product.outvars[0].aval.dtype == jnp.float32
    *_, backward = found
    # Keys' and values' gradients are summed over chunks of queries before they are rounded.
    sums = [each for each in backward.eqns if each.primitive.name in ("add", "add_any")]
    assert sums
    assert all(each.outvars[0].aval.dtype == jnp.float32 for each in sums)


def test_a_tpus_kernel_runs_on_the_device_of_its_sequences() -> None:
    # Automatic, as `Devices` makes its meshes: the default changed in jax 0.12.
    automatic = (jax.sharding.AxisType.Auto,)
    mesh = jax.sharding.AbstractMesh((8,), ("image",), axis_types=automatic)
    qkv = jax.ShapeDtypeStruct((16, 9, 384), jnp.float32)
    program = jax.make_jaxpr(lambda qkv: attention_pallas.attend(qkv, 2, 9, "highest", mesh))(qkv)
    assert "shard_map" in str(program)
    (kernel,) = [str(each) for each in program.jaxpr.eqns]
    assert "f32[2,9,384]" in kernel  # two of sixteen sequences on each of eight devices


def test_a_tpus_kernel_works_under_vmap(interpreted: list[Any]) -> None:
    params, x = network(128), sample(9, 128, 6).reshape(3, 2, 9, 128)
    expected = attention(params, x, 2)
    with lowering_for(TPU):
        found = jax.vmap(lambda x: attention(params, x, 2))(x)
    assert interpreted
    np.testing.assert_allclose(found, expected, atol=1e-6)


UNFUSED = {
    "heads of 16": {"heads": 8},
    "too many tokens": {"x": sample(11, 128)},
    "another type": {"x": jnp.ones((2, 9, 128), jnp.float16)},
}


@pytest.mark.parametrize("name", slow_unless({"heads of 16"}, UNFUSED))
def test_what_a_tpus_kernel_does_not_take_is_computed_all_the_same(
    interpreted: list[Any], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(attention_pallas._TOKENS, jnp.dtype("float32"), 10)
    told = {"x": sample(9, 128), "heads": 2} | UNFUSED[name]
    expected = attention(network(128), **told)
    with lowering_for(TPU):
        found = attention(network(128), **told)
    assert not interpreted
    tolerance = 2e-3 if found.dtype == jnp.float16 else 2e-6  # 11 bits, or 24, of order 1
    np.testing.assert_allclose(found, expected, atol=tolerance)


@pytest.mark.slow  # the next ones are of single parts
def test_an_accelerators_products_are_the_cpus() -> None:
    """In float32 a GPU has no fused attention; the order of the axes is another."""
    params, x = make()
    x, mask = jnp.stack([x, 1 - x]), jnp.tri(TOKENS, dtype=bool)
    dropped = 2.0 * jax.random.bernoulli(jax.random.key(5), 0.5, (HEADS, TOKENS, TOKENS))

    def value(params: Attention, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        y = masked_attention(params, x, mask, dropped)
        return jnp.sin(y).sum(), y

    slope = jax.grad(value, argnums=(0, 1), has_aux=True)
    expected = slope(params, x)
    with lowering_for(GPU):
        found = slope(params, x)
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=5e-6)  # sums of 100 numbers of order 1


def test_an_accelerators_cross_attention_is_the_cpus() -> None:
    params, x = make()
    tokens = jnp.stack([x, 1 - x, 2 * x])
    expected = cross_attention(params, x[:4], tokens, HEADS)
    with lowering_for(TPU):
        found = cross_attention(params, x[:4], tokens, HEADS)
    np.testing.assert_allclose(found, expected, atol=2e-6)


@pytest.mark.parametrize(("tokens", "patches"), [(257, 256), (264, 256)])
def test_cudnn_sees_eights_and_no_padding(stand_in: list[Any], tokens: int, patches: int) -> None:
    x = sample(tokens, 128).astype(jnp.bfloat16)
    turned = angles(patches, 64)
    expected, slopes = with_gradient(x, 2, rotation=turned)
    with lowering_for(GPU):
        found, gradients = with_gradient(x, 2, rotation=turned)
        whole = padded_length(tokens, x.dtype, 128, 2)
        # Numbers that would be seen at once, if anything looked at them.
        more = jnp.pad(x, ((0, 0), (0, whole - tokens), (0, 0)), constant_values=100)
        padded, _ = with_gradient(more, 2, rotation=turned, length=tokens)
    assert whole == -(-tokens // 8) * 8
    assert stand_in == 2 * [((2, whole, 2, 64), whole > tokens)]
    # bfloat16 keeps 8 bits, and the two divide at different places.
    np.testing.assert_allclose(found.astype(jnp.float32), expected.astype(jnp.float32), atol=0.02)
    # The last bit of 8, of numbers of order 0.1: larger products add up in another order.
    padded = padded[:, :tokens].astype(jnp.float32)
    np.testing.assert_allclose(padded, found.astype(jnp.float32), atol=1e-3)
    assert_slopes_agree(gradients, slopes, 0.02)


def test_cudnn_is_asked_only_where_it_can_answer(stand_in: list[Any]) -> None:
    x = sample(9, 128).astype(jnp.bfloat16)
    params = network(128)
    with lowering_for(GPU):
        attention(params, x, 32)  # heads of 4 numbers: cuDNN takes eights
        attention(network(512), sample(9, 512).astype(x.dtype), 2)  # heads of 256
        attention(params, x.astype(jnp.float32), 2)
    with lowering_for(CPU):
        attention(params, x, 2)
    assert not stand_in


@pytest.mark.parametrize("chosen", [CPU, GPU, TPU], ids=lambda chosen: chosen.platform)
def test_padding_is_never_attended_to(chosen: Target) -> None:
    """Where nothing is fused too."""
    params, x = network(24), sample(5, 24)
    more = jnp.pad(x, ((0, 0), (0, 3), (0, 0)), constant_values=100)
    with lowering_for(chosen):
        expected = attention(params, x, 3)
        found = attention(params, more, 3, length=5)
    np.testing.assert_allclose(found[:, :5], expected, atol=2e-6)  # of order 1, in float32


def test_only_fused_attention_wants_padding() -> None:
    for chosen, dtype, heads, expected in (
        (GPU, jnp.bfloat16, 12, 264),
        (GPU, jnp.float32, 12, 257),
        (TPU, jnp.bfloat16, 12, 264),
        (TPU, jnp.float32, 12, 264),
        (TPU, jnp.float32, 48, 257),
        (CPU, jnp.bfloat16, 12, 257),
    ):
        with lowering_for(chosen):
            assert padded_length(257, dtype, 768, heads) == expected


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
@pytest.mark.parametrize("batch", [(), (2,)], ids=["one", "batch"])
@pytest.mark.parametrize("masked", [False, True], ids=["plain", "masked"])
def test_a_cpu_computes_many_scores_in_parts_to_the_same_values(
    monkeypatch: pytest.MonkeyPatch, batch: tuple[int, ...], masked: bool, dtype: str
) -> None:
    keys = jax.random.split(jax.random.key(0), 3)
    parts = [jax.random.normal(key, (*batch, 7, 3, 4), jnp.dtype(dtype)) for key in keys]
    mask = jnp.tri(7, dtype=bool) if masked else None
    dropped = None
    if masked:
        dropped = jax.random.bernoulli(jax.random.key(4), 0.8, (*batch, 3, 7, 7)) / 0.8

    def loss(*parts: jax.Array) -> jax.Array:
        mixed = dot_product_attention(*parts, mask=mask, dropout_mask=dropped)
        return jnp.sin(mixed.astype(jnp.float32)).sum()

    results, loops = [], []
    of_head = 49 * (*batch, 1)[0]
    with lowering_for(CPU):
        for most in (1000, of_head, of_head // 3):  # whole, head by head, a third of a head
            monkeypatch.setattr(attention_module, "_SCORES", most)
            results.append(jax.value_and_grad(loss, argnums=(0, 1, 2))(*parts))
            program = jax.jit(lambda *parts: loss(*parts)).lower(*parts).as_text()
            loops.append(program.count("stablehlo.while"))
    assert loops == [0, 1, 1 if masked else 2]
    # Sums of seven numbers of order 1; bfloat16 rounds the same ones.
    for found in results[1:]:
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-6), results[0], found)


@pytest.mark.slow
def test_a_tpus_kernel_sees_no_padding(interpreted: list[Any]) -> None:
    x = sample(50, 128)
    more = jnp.pad(x, ((0, 0), (0, 6), (0, 0)), constant_values=100)

    def value(x: jax.Array, **options: Any) -> jax.Array:
        y = attention(network(128), x, 2, rotation=angles(48, 64), **options)
        return jnp.sin(3 * y[:, :50]).sum()

    expected, slope = jax.value_and_grad(value)(x)
    with lowering_for(TPU):
        found, gradient = jax.value_and_grad(value)(more, length=50)
    assert len(interpreted) == 2
    np.testing.assert_allclose(found, expected, atol=1e-3)  # a sum of 12,800 numbers of order 1
    np.testing.assert_allclose(gradient[:, :50], slope, atol=1e-5 * np.abs(slope).max())
    np.testing.assert_array_equal(gradient[:, 50:], 0)
