"""Choose which parameters train, and split a model into trainable and frozen parameters."""

import dataclasses
import difflib
import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase

import equinox as eqx
import jax
from jaxtyping import PyTree

from crisalad_jax.config.checks import require
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.layers import STATISTICS
from crisalad_jax.nn.model import Crisalad, check_params, parameter_shapes
from crisalad_jax.utils.pytree import named_leaves
from crisalad_jax.utils.target import target

HEAD, ADAPTERS, ALL = "head", "adapters", "all"
ADAPTERS_AND_HEAD = f"{ADAPTERS},{HEAD}"
_WORDS = (ALL, HEAD, ADAPTERS, "norm", "positions", "last-N-blocks")
_HEAD = ("aggregator", "cross_image", "projection")
_BLOCKS = "backbone.blocks."
_LAST_BLOCKS = re.compile(r"last-(\d+)-blocks")


def terms_of(trainable: str) -> list[str]:
    """Split a `trainable` value into its words and patterns.

    Example:
        >>> terms_of("adapters, head")
        ['adapters', 'head']
    """
    return [term.strip() for term in trainable.split(",")]


def shards_batch(trainable: str) -> bool:
    """Return whether a batch is sharded over devices: not on a CPU if all parameters train.

    Each device holds its own copy of the trainable parameters, of the gradient and of the moments.
    If all parameters train, these copies take most of the memory, which a CPU's devices share;
    `tiny` saves no time by sharding (docs/performance-studies.md).
    """
    return trainable != ALL or target().platform != "cpu"


def split_params(params: Crisalad, config: ModelConfig, trainable: str) -> tuple[PyTree, PyTree]:
    """Split parameters into those that train and those that are frozen.

    `trainable` is a comma-separated list of words and patterns:

    - `all`; `head` (aggregator, cross-image encoder and projection); `adapters` (what the backbone
      marks as trainable, `Backbone.trains`); `last-N-blocks`; `norm` (the last layer norm, if the
      aggregator uses it); `positions` (class token and position embeddings).
    - A pattern of dotted names, matched like file names: `*` is any text, `[01]` one of two
      characters. It matches a parameter, or a part with all its parameters. Blocks are numbered
      from 0, as in `backbone.blocks.1[01]`; without a number, `backbone.blocks.attn` matches in all
      blocks.
    - A leading `-` freezes a word or pattern.

    The paper trains "adapters,head", SALAD "last-4-blocks,norm,head".

    If only some parameters of the blocks train, the stack of blocks is cut; `merge_params` joins
    it. No gradient is then computed in frozen blocks before the first trainable one, nor for the
    input of that block if only a part of it trains. Always frozen are batch-norm statistics, though
    a step may update them, and aggregators that learn nothing (AnyLoc's).

    Args:
        params: the whole model.
        config: the model's configuration.
        trainable: the list described above.

    Returns:
        (trainable, frozen): two trees of the model's structure, with None for the other's leaves.

    Raises:
        InputError: the parameters belong to another model than `config`; a word or pattern matches
            nothing; or adapters or a part of the head neither train nor are frozen by a `-`.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad
        >>> params = init_crisalad(jax.random.key(0), PRESETS["tiny"])
        >>> trainable, frozen = split_params(params, PRESETS["tiny"], "head,-adapters")
        >>> trainable.backbone.cls_token is None, frozen.aggregator.dust_bin is None
        (True, True)
    """
    check_params(params, config)
    chosen = choose(params, config, trainable)
    # For each block, whether each of its parameters that can train does.
    in_blocks = [f for n, f in chosen.items() if len(f) > 1 and not _is_fixed(n, config)]
    rows = list(zip(*in_blocks, strict=True))
    cuts = {number for number in range(1, len(rows)) if rows[number] != rows[number - 1]}
    first = next((number for number, row in enumerate(rows) if any(row)), len(rows))
    if first + 1 < len(rows) and not all(rows[first]):
        cuts.add(first + 1)
    starts = [0, *sorted(cuts)]
    if cuts:
        backbone = config.backbone.split_blocks(params.backbone, starts[1:])
        params = dataclasses.replace(params, backbone=backbone)

    def learns(name: str) -> bool:
        if not cuts or not name.startswith(_BLOCKS):
            return any(chosen[name])
        part, _, rest = name.removeprefix(_BLOCKS).partition(".")
        by_block = chosen[_BLOCKS + rest]
        return by_block[starts[int(part)] if len(by_block) > 1 else 0]

    names = iter(named_leaves(params))
    return eqx.partition(params, jax.tree.map(lambda _: learns(next(names)), params))


def numbered_names(params: Crisalad, config: ModelConfig) -> dict[str, list[str]]:
    """Return the names of each leaf: its own, or for stacked blocks, one for each block."""
    depth, names = config.backbone.depth, {}
    for leaf, value in named_leaves(params).items():
        rest = leaf.removeprefix(_BLOCKS)
        is_stack = rest != leaf and not rest.partition(".")[0].isdecimal()
        is_stack = is_stack and value.ndim > 0 and len(value) == depth
        names[leaf] = [f"{_BLOCKS}{i}.{rest}" for i in range(depth)] if is_stack else [leaf]
    return names


def choose(params: Crisalad, config: ModelConfig, trainable: str) -> dict[str, tuple[bool, ...]]:
    """Return whether each leaf trains: one boolean, or for stacked blocks one for each block."""
    backbone, names = config.backbone, numbered_names(params, config)

    def matched(*patterns: str) -> set[tuple[str, int]]:
        return {
            (leaf, number)
            for leaf, numbered in names.items()
            for number, name in enumerate(numbered)
            if any(_matches(each, pattern) for each in (name, leaf) for pattern in patterns)
        }

    found: dict[bool, set[tuple[str, int]]] = {True: set(), False: set()}
    for term in terms_of(trainable):
        word = term.removeprefix("-")
        own = matched(*_patterns_of(word, config))
        # Models may have no head. A norm that the aggregator leaves out has no gradient: only
        # weight decay would change it.
        may_lack = word in (ALL, HEAD, "norm") or term == f"-{ADAPTERS}"
        require(bool(own) or may_lack, f"trainable: {_unmatched(word, config, names)}")
        found[word == term] |= own
    fixed = {(leaf, 0) for leaf in names if _is_fixed(leaf, config)}
    due = {f"backbone.{pattern}": ADAPTERS for pattern in backbone.trains}
    for pattern, word in (due | dict(zip(_HEAD, _HEAD, strict=True))).items():
        own = {each for each in matched(pattern) if (each[0], 0) not in fixed}
        require(
            not own or bool(own & (found[True] | found[False])),
            f"trainable: found {trainable!r}, which leaves {pattern} as it was at the start, "
            f"expected {word} too, or -{word} to freeze it",
        )
    chosen = found[True] - found[False]
    return {
        leaf: tuple((leaf, 0) not in fixed and (leaf, i) in chosen for i in range(len(numbered)))
        for leaf, numbered in names.items()
    }


def _matches(name: str, pattern: str) -> bool:
    return fnmatchcase(name, pattern) or fnmatchcase(name, f"{pattern}.*")


def _is_fixed(leaf: str, config: ModelConfig) -> bool:
    """Return whether a parameter never has a gradient."""
    constant = not config.aggregator.trainable and _matches(leaf, "aggregator")
    return constant or leaf.rpartition(".")[2] in STATISTICS


def _patterns_of(word: str, config: ModelConfig) -> Sequence[str]:
    """Return the patterns that a word stands for; any other text is a pattern itself."""
    depth, last = config.backbone.depth, _LAST_BLOCKS.fullmatch(word)
    if last is not None:
        fits = 1 <= int(last[1]) <= depth
        require(fits, f"trainable: found {word}, expected 1 to the backbone's {depth} blocks")
        return [f"{_BLOCKS}{number}" for number in range(depth - int(last[1]), depth)]
    words: Mapping[str, Sequence[str]] = {
        ALL: ["*"],
        HEAD: _HEAD,
        ADAPTERS: [f"backbone.{pattern}" for pattern in config.backbone.trains],
        "norm": ["backbone.norm"] if config.aggregator.features(depth).norm else [],
        "positions": ["backbone.cls_token", "backbone.pos_embed*"],
    }
    return words.get(word, [word])


def _unmatched(word: str, config: ModelConfig, names: Mapping[str, Iterable[str]]) -> str:
    """Say that a word or pattern matches nothing, and which names are similar."""
    known: dict[str, None] = dict.fromkeys(_WORDS)
    for name in itertools.chain(names, *names.values()):
        known |= dict.fromkeys(itertools.accumulate(name.split("."), "{}.{}".format))
    near = difflib.get_close_matches(word, known, n=3)
    hint = f" (near: {', '.join(near)})" if near and word not in _WORDS else ""
    return (
        f"found {word!r}, which matches no parameter of backbone {config.backbone.part_name} with "
        f"aggregator {config.aggregator.part_name}, expected {', '.join(_WORDS)}, or a pattern of "
        f"names{hint}"
    )


def merge_params(trainable: PyTree, frozen: PyTree, config: ModelConfig) -> Crisalad:
    """Join the two trees of `split_params` into the whole model.

    Args:
        trainable: tree of the trainable parameters.
        frozen: tree of the frozen parameters.
        config: the model's configuration.

    Returns:
        The whole model, with the blocks that `split_params` separated joined again.

    Raises:
        InputError: the parameters belong to another model than `config`.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> merged = merge_params(*split_params(params, config, "adapters,head"), config)
        >>> jax.tree.structure(merged) == jax.tree.structure(params)
        True
    """
    params = eqx.combine(trainable, frozen)
    check_params(params, config)
    return dataclasses.replace(params, backbone=config.backbone.join_blocks(params.backbone))


def count_trainable(config: ModelConfig, trainable: str) -> int:
    """Count the parameters that train; raises like `split_params`."""
    chosen = jax.eval_shape(
        lambda params: split_params(params, config, trainable)[0], parameter_shapes(config)
    )
    return sum(leaf.size for leaf in jax.tree.leaves(chosen))
