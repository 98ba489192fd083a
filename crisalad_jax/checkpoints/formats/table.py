"""Convert parameters to the arrays of a public format, and back."""

import dataclasses
import re
from collections.abc import Mapping

import jax
import numpy as np

from crisalad_jax.checkpoints.formats.families import FORMATS, REFERENCE, VOCABULARY
from crisalad_jax.checkpoints.formats.rows import Absent, Extra, Form, Row
from crisalad_jax.checkpoints.formats.sizes import State
from crisalad_jax.config.checks import choose
from crisalad_jax.config.io import differences
from crisalad_jax.config.part import with_non_semantic_fields_of
from crisalad_jax.nn.adapters.bottleneck import BottleneckAdapter
from crisalad_jax.nn.backbones.vit import VisionTransformer
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, parameter_shapes
from crisalad_jax.utils.errors import InputError, few
from crisalad_jax.utils.pytree import named_leaves


def table(config: ModelConfig, name: str) -> list[Row]:
    """Return the rows for a model in the format `name`, without the prefix of `Format.inside`.

    Raises:
        InputError: there is no such format, or it cannot hold a part of the model.
    """
    form = choose("format", name, FORMATS)
    form.check_parts(config)
    names = _numbered(_blank(config))
    rows = list(form.lines(config, names))
    left_out = names.keys() - {ours for row in rows for ours in row.ours}
    if left_out and not form.bare:
        raise InputError(f"format {name}: found {few(sorted(left_out))}, expected none of these")
    return rows


def _blank(config: ModelConfig) -> dict[str, np.ndarray]:
    """Return arrays of a model's shapes by name, which take no memory; empty ones are left out."""
    return {
        name: np.broadcast_to(np.zeros((), leaf.dtype), leaf.shape)
        for name, leaf in named_leaves(parameter_shapes(config)).items()
        if leaf.size
    }


def check_holds(config: ModelConfig, name: str) -> ModelConfig:
    """Check that a model can be written in the format `name` and read back as the same model.

    Returns:
        The configuration that reading such a file infers; its image size, for example, may differ.

    Raises:
        InputError: the format does not exist or cannot hold a part; or a setting that shapes do
            not show differs from the published one, which reading would return instead.
    """
    state = _blank_state(config, name)
    if name in (REFERENCE, VOCABULARY):  # contain their configuration, or no model
        return config
    read_back = FORMATS[name].infer(state)
    wrong = differences(_shown(with_non_semantic_fields_of(config, read_back)), _shown(config))
    if wrong:
        raise InputError(
            f"format {name}: cannot store settings other than the published ones: "
            f"{'; '.join(wrong)} (format {REFERENCE} can)"
        )
    return read_back


def _shown(config: ModelConfig) -> ModelConfig:
    """Reset the fields of a configuration that a trained model's arrays do not show."""
    backbone = config.backbone
    if not isinstance(backbone, VisionTransformer):
        return config
    adapter = backbone.adapter
    if isinstance(adapter, BottleneckAdapter):
        bottleneck = adapter.width(backbone.dim) / backbone.dim
        adapter = dataclasses.replace(adapter, bottleneck=bottleneck)
    backbone = dataclasses.replace(
        backbone, mlp_ratio=backbone.hidden / backbone.dim, adapter=adapter
    )
    return dataclasses.replace(config, backbone=backbone)


def public_shapes(config: ModelConfig, name: str) -> dict[str, tuple[int, ...]]:
    """Return the shape of every array of a model in the format `name`, by public name.

    Raises:
        InputError: there is no such format, or it cannot hold a part of the model.
    """
    return {theirs: array.shape for theirs, array in _blank_state(config, name).items()}


def _blank_state(config: ModelConfig, name: str) -> dict[str, np.ndarray]:
    return _theirs(_blank(config), table(config, name), config, None)


def to_params(
    state: State, config: ModelConfig, name: str, *, source: str
) -> tuple[Crisalad, dict[str, np.ndarray]]:
    """Convert arrays of the format `name` to (parameters, extras), numpy arrays of the same types.

    The extras are arrays of public checkpoints that no descriptor needs and that a file may lack:
    DINOv2's mask token, the batch counts of batch norms, DINOv3's rotary periods.

    Raises:
        InputError: arrays are missing, unknown or misshaped; the message names them and `source`.
    """
    lines, blank = table(config, name), _blank(config)
    shapes = {name: array.shape for name, array in _theirs(blank, lines, config, None).items()}
    extras = {row.theirs[0] for row in lines if isinstance(row.form, Extra)}
    problems = [f"{theirs} missing" for theirs in shapes.keys() - state.keys() - extras]
    problems += [f"{theirs} unknown" for theirs in state.keys() - shapes.keys()]
    problems += [
        f"{theirs} found {state[theirs].shape}, expected {shape}"
        for theirs, shape in shapes.items()
        if theirs in state and state[theirs].shape != shape
    ]
    if problems:
        raise InputError(
            f"{source}: does not fit the format {name} of width {config.backbone.dim} and "
            f"{config.backbone.depth} blocks: {few(sorted(problems))}"
        )
    ours, read = {}, {}
    for row in lines:
        arrays = [state[name] for name in row.theirs if name in state]
        if isinstance(row.form, Form):
            ours |= zip(row.ours, row.form.ours(*arrays), strict=True)
        elif isinstance(row.form, Absent):
            ours[row.ours[0]] = np.full(blank[row.ours[0]].shape, row.form.value, np.float32)
        elif isinstance(row.form, Extra) and arrays:
            (read[row.ours[0]],) = row.form.form.ours(*arrays)
    return _from_numbered(ours, config), read


def to_state(
    params: Crisalad, config: ModelConfig, name: str, extras: State
) -> dict[str, np.ndarray]:
    """Return arrays by public name, the inverse of `to_params`; missing extras get initial values.

    Raises:
        InputError: the format cannot hold a part of this model.
    """
    leaves = {leaf: np.asarray(array) for leaf, array in named_leaves(params).items()}
    state = _theirs(leaves, table(config, name), config, extras)
    return {theirs: np.ascontiguousarray(x).reshape(x.shape) for theirs, x in state.items()}


def _theirs(
    leaves: State, lines: list[Row], config: ModelConfig, extras: State | None
) -> dict[str, np.ndarray]:
    """Return public arrays; if `extras` is None, all that a file may have, with initial values."""
    ours, state = _numbered(leaves), {}
    for row in lines:
        if isinstance(row.form, Form):
            state |= zip(row.theirs, row.form.theirs(*map(ours.get, row.ours)), strict=True)
        elif isinstance(row.form, Extra):
            extra = (extras or {}).get(row.ours[0])
            if extra is None and extras is not None and row.form.optional:
                continue
            array = row.form.initial(config) if extra is None else extra
            (state[row.theirs[0]],) = row.form.form.theirs(array)
    return state


_STACK = re.compile(r"backbone\.blocks\.(?!\d)")
"""Prefix of the names of stacked blocks; blocks that are not stacked have numbers already."""


def _numbered(leaves: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Split stacks of blocks into single blocks, with numbered names."""
    single: dict[str, np.ndarray] = {}
    for name, leaf in leaves.items():
        if start := _STACK.match(name):
            rest = name[start.end() :]
            single |= {f"{start[0]}{i}.{rest}": block for i, block in enumerate(leaf)}
        else:
            single[name] = leaf
    return single


def _from_numbered(ours: State, config: ModelConfig) -> Crisalad:
    """Invert `_numbered`; empty arrays, such as absent registers, have no row in any table."""
    template = parameter_shapes(config)
    leaves = []
    for name, leaf in named_leaves(template).items():
        if not leaf.size:
            leaves.append(np.zeros(leaf.shape, leaf.dtype))
        elif start := _STACK.match(name):
            rest = name[start.end() :]
            leaves.append(np.stack([ours[f"{start[0]}{i}.{rest}"] for i in range(leaf.shape[0])]))
        else:
            leaves.append(ours[name])
    return jax.tree.unflatten(jax.tree.structure(template), leaves)
