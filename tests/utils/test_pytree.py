"""Parameters as they print."""

import jax
import jax.numpy as jnp
import numpy as np

import crisalad_jax as cj


@cj.pytree_dataclass
class Pair:
    left: object
    right: object


def test_leaves_are_printed_by_name_shape_and_type():
    pair = Pair({"deep": np.zeros((2, 3), np.float16)}, jnp.ones(4))
    assert repr(pair).splitlines() == [
        "Pair",
        "  left.deep  (2, 3)  float16",
        "  right      (4,)    float32",
        "2 leaves, 10 parameters, 28 bytes",  # 6 of 2 bytes and 4 of 4
    ]


def test_leaves_without_values_are_printed():
    seen = []
    shape = jax.ShapeDtypeStruct((1000, 500), jnp.float32)
    jax.eval_shape(lambda pair: seen.append(repr(pair)), Pair(shape, None))
    lines = ["Pair", "  left  (1000, 500)  float32", "1 leaf, 500,000 parameters, 2.0 MB"]
    assert seen == ["\n".join(lines)]
    for rows, size in ((750, "1.5 MB"), (200, "400.0 kB"), (10**6, "2.0 GB")):
        text = repr(Pair(jax.ShapeDtypeStruct((rows, 500), jnp.float32), None))
        assert text.endswith(f"1 leaf, {rows * 500:,} parameters, {size}")
    assert repr(Pair(shape, None)) == seen[0]
    assert repr(Pair(None, "label")).splitlines()[1:] == [
        "  right  str",
        "1 leaf, 0 parameters, 0 bytes",
    ]


def test_a_model_is_printed_without_its_values(monkeypatch):
    params = jax.eval_shape(lambda key: cj.init_crisalad(key, cj.PRESETS["b14"]), jax.random.key(0))
    text = repr(params)
    # Of a block 768 x 2304 + 2304 for queries, keys and values, and 768 x 768 + 768 after them.
    assert f"\n  backbone.blocks.attn             4 leaves       {12 * 2_362_368:,}\n" in text
    assert "\n  backbone.pos_embed               (37, 37, 768)  float32\n" in text
    assert len(text.splitlines()) <= 26
    # docs/architecture.md: 11,495,105 trainable and 86,579,712 frozen.
    assert text.endswith(f"{11_495_105 + 86_579_712:,} parameters, 392.3 MB")
