"""Which parameters train, and the split of a model into these and the frozen ones."""

import dataclasses
import re

import equinox as eqx
import jax
from jaxtyping import PyTree

from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.layers import STATISTICS
from crisalad_jax.nn.model import Crisalad, check_params, parameter_shapes
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import named_leaves
from crisalad_jax.utils.target import target

HEAD, ADAPTERS_AND_HEAD, ALL = "head", "adapters+head", "all"
_LAST_BLOCKS = re.compile(r"last-(\d+)-blocks(\+positions)?(\+no-norm)?\+head")
TRAINABLE = re.compile(f"{HEAD}|{re.escape(ADAPTERS_AND_HEAD)}|{ALL}|{_LAST_BLOCKS.pattern}")
"""Names of what trains, as `split_params` takes them."""
EXPECTED = (
    f"{HEAD}, {ADAPTERS_AND_HEAD}, last-N-blocks+head (or +positions+head, +no-norm+head) or {ALL}"
)


def shards_batch(trainable: str) -> bool:
    """Return whether a batch is sharded over devices: not on a CPU where all parameters train.

    Each device holds its own copy of what trains, of the gradient and of the moments. If all
    parameters train, these copies take most of the memory, which a CPU's devices share; `tiny`
    saves no time by sharding (docs/performance.md).
    """
    return trainable != ALL or target().platform != "cpu"


def split_params(params: Crisalad, config: ModelConfig, trainable: str) -> tuple[PyTree, PyTree]:
    """Split parameters into those that train and those that are frozen.

    If some of the blocks train, the backbone's stack is cut in two, and `merge_params` joins it. So
    no gradient is computed in the frozen blocks before the last N, nor in the whole first block if
    only its adapter trains. Batch-norm statistics have no gradient and count as frozen, though a
    step may update them. So does an aggregator that learns nothing (AnyLoc's vocabulary).

    Args:
        params: the whole model.
        config: the model's.
        trainable: "adapters+head" (the paper: adapters, aggregator, cross-image encoder), "head"
            (the last two alone), "all", or "last-N-blocks+head" (SALAD: the last N blocks, the
            final layer norm if the aggregator asks for it, and the head). Of the last,
            "last-N-blocks+positions+head" also trains the class token and the positions (DINO-Mix),
            and "last-N-blocks+no-norm+head" freezes the layer norm (SuperVLAD).

    Returns:
        (trainable, frozen): two trees of the model's structure, None for the other's leaves.

    Raises:
        InputError: parameters of another model, an unknown name, more blocks than there are, or a
            backbone without blocks.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad
        >>> params = init_crisalad(jax.random.key(0), PRESETS["tiny"])
        >>> trainable, frozen = split_params(params, PRESETS["tiny"], "head")
        >>> trainable.backbone.cls_token is None, frozen.aggregator.dust_bin is None
        (True, True)
    """
    check_params(params, config)
    head = ("aggregator.", "cross_image.", "projection.")
    match = _LAST_BLOCKS.fullmatch(trainable)
    if trainable == ALL:
        prefixes: tuple[str, ...] = ("",)
    elif trainable == HEAD:
        prefixes = head
    elif trainable == ADAPTERS_AND_HEAD:
        params = _cut_blocks(params, config, 1)
        prefixes = (*head, "backbone.blocks.0.adapter.", "backbone.blocks.1.adapter.")
    elif match:
        last, depth = int(match[1]), config.backbone.depth
        if last > depth:
            raise InputError(f"trainable: found the last {last} blocks, expected at most {depth}")
        params = _cut_blocks(params, config, depth - last)
        prefixes = (*head, "backbone.blocks.1.")
        # Without a gradient a weight decay alone would move the norm.
        if not match[3] and config.aggregator.features(depth).norm:
            prefixes += ("backbone.norm.",)
        if match[2]:
            prefixes += ("backbone.cls_token", "backbone.pos_embed")
    else:
        raise InputError(f"trainable: found {trainable!r}, expected {EXPECTED}")
    constant = () if config.aggregator.trainable else ("aggregator.",)
    names = iter(named_leaves(params))

    def learns(name: str) -> bool:
        measured = name.rpartition(".")[2] in STATISTICS
        fixed = measured or (constant and name.startswith(constant))
        return name.startswith(prefixes) and not fixed

    chosen = jax.tree.map(lambda _: learns(next(names)), params)
    return eqx.partition(params, chosen)


def _cut_blocks(params: Crisalad, config: ModelConfig, first: int) -> Crisalad:
    backbone = config.backbone.split_blocks(params.backbone, first)
    return dataclasses.replace(params, backbone=backbone)


def merge_params(trainable: PyTree, frozen: PyTree, config: ModelConfig) -> Crisalad:
    """Join the two trees of `split_params` to the whole model.

    Args:
        trainable: what trains.
        frozen: what does not.
        config: the model's.

    Returns:
        The whole model, with one stack of blocks.

    Raises:
        InputError: parameters of another model.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> merged = merge_params(*split_params(params, config, "adapters+head"), config)
        >>> jax.tree.structure(merged) == jax.tree.structure(params)
        True
    """
    params = eqx.combine(trainable, frozen)
    check_params(params, config)
    return dataclasses.replace(params, backbone=config.backbone.join_blocks(params.backbone))


def count_trainable(config: ModelConfig, trainable: str) -> int:
    """Count the parameters that train; raises as `split_params`."""
    chosen = jax.eval_shape(
        lambda params: split_params(params, config, trainable)[0], parameter_shapes(config)
    )
    return sum(leaf.size for leaf in jax.tree.leaves(chosen))
