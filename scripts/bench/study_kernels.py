"""Compare JAX's attention kernels for TPUs with ours by libtpu's estimates, without running them.

    python scripts/bench/study_kernels.py [--target v5e-1] [--program describe] [--images 192]

`b14` in bfloat16 is compiled with each kernel in place of ours, and libtpu's estimate is read in
the same way as in `scripts.compile_check`, with the same requirements. JAX's kernels take whole
blocks of 128 tokens with the head axis first, so 257 tokens are padded to 384.
"""

import argparse
import dataclasses
import functools
import pathlib
import sys
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

sys.path.insert(0, str(pathlib.Path(__file__).parents[2]))  # scripts.compile_check

from crisalad_jax import recipe
from crisalad_jax.nn import attention_pallas
from scripts.compile_check import compile_check
from scripts.compile_check.targets import compile_on_cpu

BLOCK = 128


def flash(qkv: Array, heads: int, length: int, *_: Any) -> Array:
    """Attend like `attention_pallas.attend`, with JAX's flash attention."""
    from jax.experimental.pallas.ops.tpu import flash_attention as kernels

    padded, queries, keys, values = _heads_first(qkv, heads)
    valid = jnp.broadcast_to(jnp.arange(padded) < length, (len(qkv), padded)).astype(jnp.int32)
    mixed = kernels.flash_attention(
        queries,
        keys,
        values,
        # Padding attends only to padding.
        segment_ids=kernels.SegmentIds(valid, valid),
        sm_scale=queries.shape[-1] ** -0.5,
        block_sizes=_flash_blocks(kernels.BlockSizes, padded),
    )
    return _side_by_side(mixed, qkv)


def splash(qkv: Array, heads: int, length: int, *_: Any) -> Array:
    """Attend like `attention_pallas.attend`, with JAX's splash attention."""
    from jax.experimental.pallas.ops.tpu.splash_attention import splash_attention_kernel as kernels
    from jax.experimental.pallas.ops.tpu.splash_attention import splash_attention_mask as masks

    padded, queries, keys, values = _heads_first(qkv, heads)
    whole = masks.FullMask((padded, padded))
    names = ("block_q", "block_kv", "block_kv_compute")
    names += ("block_q_dkv", "block_kv_dkv", "block_kv_dkv_compute")
    kernel = kernels.make_splash_mha_single_device(
        masks.MultiHeadMask([whole] * heads),
        block_sizes=kernels.BlockSizes(**dict.fromkeys(names, padded), use_fused_bwd_kernel=True),
    )
    valid = (jnp.arange(padded) < length).astype(jnp.int32)
    each = functools.partial(kernel, segment_ids=kernels.SegmentIds(valid, valid))
    scaled = queries * queries.shape[-1] ** -0.5
    mixed: Any = jax.vmap(each)(scaled, keys, values)
    return _side_by_side(mixed, qkv)


def _heads_first(qkv: Array, heads: int) -> tuple[int, Array, Array, Array]:
    batch, tokens, three = qkv.shape
    padded = -(-tokens // BLOCK) * BLOCK
    qkv = jnp.pad(qkv, ((0, 0), (0, padded - tokens), (0, 0)))
    parts = qkv.reshape(batch, padded, 3, heads, three // 3 // heads)
    queries, keys, values = jnp.moveaxis(parts, (2, 3), (0, 2))
    return padded, queries, keys, values


def _side_by_side(mixed: Array, qkv: Array) -> Array:
    batch, tokens, three = qkv.shape
    return mixed.swapaxes(1, 2)[:, :tokens].reshape(batch, tokens, three // 3)


def _flash_blocks(blocks: Any, padded: int) -> Any:
    """Take all tokens of an image at once, as ours does, and one image of the batch at a time."""
    names = ("block_q", "block_k_major", "block_k")
    names += ("block_q_major_dkv", "block_k_major_dkv", "block_k_dkv", "block_q_dkv")
    names += ("block_k_major_dq", "block_k_dq", "block_q_dq")
    return blocks(**dict.fromkeys(names, padded), block_b=1)


KERNELS: Mapping[str, Callable[..., Array] | None] = {
    "ours": attention_pallas.attend,
    "flash": flash,
    "splash": splash,
    "XLA's own": None,
}


def main() -> None:
    """Print a row for each kernel."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--target", choices=("v5e-1", "v6e-1"), default="v5e-1")
    parser.add_argument("--program", choices=("describe", "train"), default="describe")
    parser.add_argument("--images", type=int, default=192)
    given = parser.parse_args()
    compile_on_cpu()
    config = recipe("b14")
    # JAX's kernels support no other precision for bfloat16.
    model = dataclasses.replace(config.model, compute_dtype="bfloat16", precision="default")
    config = dataclasses.replace(config, model=model)
    fits = attention_pallas.fits
    print("| attention | compiler, ms | its kernels, ms | HBM, GB | memory, GB |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for name, attend in KERNELS.items():
        jax.clear_caches()
        attention_pallas.fits = fits if attend else lambda *_: False
        attention_pallas.attend = attend or attention_pallas.attend
        check = compile_check(
            config, [given.target], programs=[given.program], images=given.images, quiet=True
        )
        for line in check.failures:
            print(f"| {name} | {line} |")
        for each in check.programs:
            figures = 1e3 * (each.compiler or 0), 1e3 * (each.kernels or 0)
            sizes = each.hbm_bytes / 1e9, each.memory / 1e9
            print(f"| {name} |", " | ".join(f"{x:.4g}" for x in (*figures, *sizes)), "|")


if __name__ == "__main__":
    main()
