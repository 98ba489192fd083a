"""Tables of layouts, and the conversion of arrays to a layout and back."""

import dataclasses
import re
from collections.abc import Mapping, Set
from typing import Any, NamedTuple

import jax
import numpy as np

from crisalad_jax.checkpoints.layouts.base import LAYOUTS, State
from crisalad_jax.checkpoints.layouts.dinov2 import parts_in_words
from crisalad_jax.checkpoints.layouts.forms import Absent, Entry, Extra
from crisalad_jax.checkpoints.layouts.readings import Reading, readings
from crisalad_jax.config.checks import choose
from crisalad_jax.config.io import differences
from crisalad_jax.config.part import with_non_semantic_fields_of
from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.backbones.vit import VisionTransformer
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, parameter_shapes
from crisalad_jax.utils.errors import InputError, few
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.pytree import named_leaves


def table(config: ModelConfig, layout: str) -> list[Entry | Extra | Absent]:
    """Return a layout's table for a model, in the public order, without the prefix `module.`.

    Raises:
        InputError: no such layout, or the model has parts that it cannot hold.
    """
    chosen = choose("layout", layout, LAYOUTS)
    expected = chosen.accepts(config)
    if expected is not None:
        raise InputError(
            f"layout {layout}: found a model of {parts_in_words(config)}, expected {expected} "
            "(layout reference holds any)"
        )
    return list(chosen.lines(config))


class Inferred(NamedTuple):
    """What a state is."""

    layout: str
    config: ModelConfig
    state: State
    """The arrays by the layout's own names."""


def infer(state: State, *, source: str) -> tuple[str, ModelConfig]:
    """Return the layout and the configuration that `identify` infers, and raise what it raises."""
    return identify(state, source=source)[:2]


def identify(state: State, *, source: str) -> Inferred:
    """Infer the layout and the configuration of a state, from its names and shapes.

    Settings that no shape shows are the published ones: heads of width 64 in the backbone, 16 heads
    in the encoder, alpha 0.2, three Sinkhorn iterations, the family's image size and resize. Names
    of wrappers are taken away (see `readings`); a note says what else is left out.

    Raises:
        InputError: naming `source`, if the names are of no layout or the widths of no model.
    """
    found: list[tuple[int, Inferred, Reading]] = []
    problems: list[str] = []
    for reading in readings(state):
        for layout in LAYOUTS.values():
            if layout.infer is not None and layout.detects(reading.state):
                try:
                    config = layout.infer(reading.state)
                    names = public_shapes(config, layout.name).keys()
                except InputError as error:
                    problems.append(f"{error}, as in {layout.holds}")
                else:
                    inferred = Inferred(layout.name, config, reading.state)
                    found.append((len(names ^ reading.state.keys()), inferred, reading))
        if any(unlike == 0 for unlike, *_ in found):
            break
    if found:
        # Families share names: the one that holds most of them, and the first of equals.
        _, inferred, reading = min(found, key=lambda each: each[0])
        _tell_left_out(reading, source)
        return inferred
    if problems:
        raise InputError(f"{source}: {problems[0]}")
    for reading in readings(state):
        _check_halves(reading.state, source)
    names = ", ".join(sorted(state)[:3]) or "none"
    raise InputError(
        f"{source}: found no checkpoint that we know (its first names: {names}), expected one of "
        f"the {len(LAYOUTS)} kinds that `crisalad convert --help-all` lists"
    )


def renamed_to(state: State, names: Set[str]) -> State:
    """Return the reading of a state that has the most of these names, and no others."""
    return min((each.state for each in readings(state)), key=lambda x: len(names ^ x.keys()))


def _tell_left_out(reading: Reading, source: str) -> None:
    if reading.left_out:
        kinds = dict.fromkeys(name.partition(".")[0] for name in reading.left_out)
        warn(
            f"{source}: took the model under {reading.inside.removesuffix('.')}, and left out "
            f"{len(reading.left_out)} tensors of {', '.join(kinds)}"
        )


def _check_halves(state: State, source: str) -> None:
    """Raise InputError where a state is the head of a family without its backbone, or the reverse.

    Families share the names of their parts: the message has all that it may be of.
    """
    layouts = LAYOUTS.values()
    heads = [layout.holds for layout in layouts if layout.has_head(state)]
    backbones = [layout.holds for layout in layouts if layout.has_backbone(state)]
    for here, families, missing in (("head", heads, "backbone"), ("backbone", backbones, "head")):
        if families:
            raise InputError(
                f"{source}: found a {here} without its {missing}, expected both in one file, as in "
                f"{' or '.join(families)}"
            )


def check_holds(config: ModelConfig, layout: str, extras: State | None = None) -> ModelConfig:
    """Check that a model can be written in `layout` and read back as the same model.

    Returns:
        The configuration that is inferred from its file, which may have other free fields.

    Raises:
        InputError: what `table` raises; a setting that no shape tells and that differs from the
            published one, which reading would take for it; or extras that the layout has no place
            for.
    """
    lines = [line for line in table(config, layout) if isinstance(line, Extra)]
    given = [(line, (extras or {})[line.name]) for line in lines if line.name in (extras or {})]
    for line, array in given:
        if not line.fits(array.shape) or array.dtype != np.dtype(line.dtype):
            raise InputError(
                f"extra.{line.name}: found {array.dtype} {array.shape}, expected "
                f"{np.dtype(line.dtype)} {line.shape}"
            )
        if not np.isfinite(array).all():
            raise InputError(f"extra.{line.name}: holds NaN or infinity")
    if layout == "reference" or LAYOUTS[layout].infer is None:
        return config
    shapes = public_shapes(config, layout)
    blank = {name: np.broadcast_to(np.float32(0), shape) for name, shape in shapes.items()}
    blank |= {line.theirs: line.stored(extras or {}) for line in lines}
    read_back = infer(blank, source=f"layout {layout}")[1]
    wrong = differences(_told(with_non_semantic_fields_of(config, read_back)), _told(config))
    if wrong:
        raise InputError(
            f"layout {layout}: cannot tell these apart from the published ones: "
            f"{'; '.join(wrong)} (layout reference can)"
        )
    return read_back


def _told(config: ModelConfig) -> ModelConfig:
    """Return a configuration with all fields reset that a trained model's arrays do not show."""
    backbone = config.backbone
    if not isinstance(backbone, VisionTransformer):
        return config
    adapter = backbone.adapter
    if adapter.kind != "none":
        kernel = {} if adapter.kind == "depthwise" else {"kernel_size": AdapterConfig.kernel_size}
        bottleneck = backbone.adapter_dim / backbone.dim
        adapter = dataclasses.replace(adapter, bottleneck=bottleneck, **kernel)
    backbone = dataclasses.replace(
        backbone, mlp_ratio=backbone.hidden / backbone.dim, adapter=adapter
    )
    return dataclasses.replace(config, backbone=backbone)


def public_shapes(config: ModelConfig, layout: str) -> dict[str, tuple[int, ...]]:
    """Return every name of a layout with its shape, in the public order.

    Raises:
        InputError: what `table` raises.
    """
    wanted = _numbered(named_leaves(parameter_shapes(config)))
    shapes: dict[str, tuple[int, ...]] = {}
    for line in table(config, layout):
        if isinstance(line, Extra):
            shapes[line.theirs] = line.stored({}).shape
        elif isinstance(line, Entry):
            # Broadcast arrays have shapes without memory of their own.
            blanks = (np.broadcast_to(np.float32(0), wanted[name].shape) for name in line.ours)
            arrays = line.form.theirs(*blanks)
            shapes |= {name: x.shape for name, x in zip(line.theirs, arrays, strict=True)}
    return shapes


def to_params(
    state: State, config: ModelConfig, layout: str, *, source: str
) -> tuple[Crisalad, dict[str, np.ndarray]]:
    """Convert arrays by public name to (parameters, extras), as numpy arrays of the same types.

    The extras are arrays of public checkpoints that no descriptor needs, and that a file may lack:
    DINOv2's mask token, the batch norms' counts of batches, DINOv3's periods.

    Raises:
        InputError: naming `source` and the first names that are missing, unknown or misshaped.
    """
    shapes = public_shapes(config, layout)
    for line in table(config, layout):
        if isinstance(line, Extra) and line.theirs not in state:
            del shapes[line.theirs]
        elif isinstance(line, Extra) and line.fits(state[line.theirs].shape):
            shapes[line.theirs] = state[line.theirs].shape
    problems = [f"{name} missing" for name in shapes.keys() - state.keys()]
    problems += [f"{name} unknown" for name in state.keys() - shapes.keys()]
    problems += [
        f"{name} found {state[name].shape}, expected {shape}"
        for name, shape in shapes.items()
        if name in state and state[name].shape != shape
    ]
    if problems:
        raise InputError(
            f"{source}: does not fit the layout {layout} of {_size(config)}: "
            f"{few(sorted(problems, key=_natural))}"
        )
    template = named_leaves(parameter_shapes(config))
    ours: dict[str, np.ndarray] = {}
    extras: dict[str, np.ndarray] = {}
    for line in table(config, layout):
        if isinstance(line, Extra):
            if line.theirs in state:
                (extras[line.name],) = line.form.ours(state[line.theirs])
        elif isinstance(line, Absent):
            shape = template[line.ours].shape
            ours[line.ours] = np.full(shape, line.value, np.float32)
        else:
            arrays = line.form.ours(*(state[name] for name in line.theirs))
            ours |= zip(line.ours, arrays, strict=True)
    return _from_numbered(ours, config), extras


def to_state(
    params: Crisalad, config: ModelConfig, layout: str, extras: State
) -> dict[str, np.ndarray]:
    """Undo `to_params`, in the public order; missing extras have their initial values.

    Raises:
        InputError: the layout has no place for a part of this model.
    """
    ours = _numbered(named_leaves(params))
    state: dict[str, np.ndarray] = {}
    for line in table(config, layout):
        if isinstance(line, Extra):
            state[line.theirs] = line.stored(extras)
        elif isinstance(line, Entry):
            arrays = line.form.theirs(*(np.asarray(ours[name]) for name in line.ours))
            state |= zip(line.theirs, arrays, strict=True)
    return {name: np.ascontiguousarray(x).reshape(x.shape) for name, x in state.items()}


_STACK = re.compile(r"backbone\.blocks\.(?!\d)")
"""Beginning of the names of stacked blocks; blocks that are no stack have numbers already."""


def _numbered(leaves: Mapping[str, Any]) -> dict[str, Any]:
    """Split stacks of blocks into single blocks, with numbered names."""
    cut: dict[str, Any] = {}
    for name, leaf in leaves.items():
        if not _STACK.match(name):
            cut[name] = leaf
            continue
        for i in range(leaf.shape[0]):
            if isinstance(leaf, jax.ShapeDtypeStruct):
                single: Any = jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype)
            else:
                single = leaf[i]
            cut[_name_of_block(name, i)] = single
    return cut


def _name_of_block(name: str, number: int) -> str:
    return _STACK.sub(lambda match: f"{match[0]}{number}.", name)


def _from_numbered(ours: State, config: ModelConfig) -> Crisalad:
    template = parameter_shapes(config)
    leaves = []
    for name, leaf in named_leaves(template).items():
        if _STACK.match(name):
            leaves.append(np.stack([ours[_name_of_block(name, i)] for i in range(leaf.shape[0])]))
        else:
            # Empty arrays, such as absent registers, have no line in any table.
            leaves.append(ours[name] if leaf.size else np.zeros(leaf.shape, leaf.dtype))
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def _size(config: ModelConfig) -> str:
    backbone = config.backbone
    return f"width {backbone.dim} and {backbone.depth} blocks"


def _natural(text: str) -> list[Any]:
    """Return a sort key that puts block 10 after block 9."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", text)]
