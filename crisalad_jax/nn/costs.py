"""Count a model's parameters, and the multiply-accumulates of its traced program."""

import collections
import dataclasses
import functools
import math
import re
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend import core

from crisalad_jax.nn.backbones.vit import run_blocks
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.layers import TAPS
from crisalad_jax.nn.model import attend_across_images, extract_tokens, parameter_shapes, self_mask
from crisalad_jax.utils.pytree import named_leaves
from crisalad_jax.utils.target import PORTABLE, lowering_for

_SCOPES = {
    "projection": "projection",
    "cross_image": "cross-image encoder",
    "aggregator": "aggregator",
    "adapter": "adapters",
    "blocks": "backbone blocks",
    "backbone": "backbone embedding, norm",
}
"""Model part by scope, in the names of programs and parameters; innermost scopes come first."""


_NAMES = re.compile(r"\w+")
"""JAX wraps scope names in transformations, as in vmap(taps)."""


class PartCost(NamedTuple):
    """The parameters and multiply-accumulates of one part of the model."""

    part: str
    parameters: int
    macs: int
    """Number of multiply-accumulates per image in matrix products and convolutions."""


@lowering_for(PORTABLE)
def part_costs(config: ModelConfig, *, images: int = 1) -> list[PartCost]:
    """Count the parameters of each part, and its multiply-accumulates per image.

    Work that is done once per batch, independent of its images, is not counted.

    Args:
        config: the model's configuration; images are of its `input_size`.
        images: number of images that attend to each other in the cross-image encoder. It affects
            only the cost of the encoder's attention.

    Returns:
        One `PartCost` for each part, from the input to the descriptor.

    Example:
        >>> from crisalad_jax import PRESETS
        >>> [cost.part for cost in part_costs(PRESETS["tiny"])][-1]
        'cross-image encoder'
    """
    params = parameter_shapes(config)
    config = dataclasses.replace(config, compute_dtype="float32")  # counts hold for any type

    extract = functools.partial(extract_tokens, config=config)

    def pixels(count: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((count, *config.input_size, 3), jnp.uint8)

    single, double = (count_macs(extract, params, pixels(count)) for count in (1, 2))
    macs = {part: double[part] - single[part] for part in _SCOPES.values()}
    attend = functools.partial(attend_across_images, config=config, mask=self_mask(images))
    attended = count_macs(attend, params, jax.eval_shape(extract, params, pixels(images)))
    macs |= {part: count // images for part, count in attended.items()}
    counts = collections.Counter[str]()
    for name, leaf in named_leaves(params).items():
        counts[_part_of(name)] += math.prod(leaf.shape)
    return [
        PartCost(part, counts[part], macs[part])
        for part in reversed(_SCOPES.values())
        if part != "projection" or counts[part]
    ]


def _part_of(text: str) -> str:
    """Return the model part of a parameter's name or a program's scope; empty if there is none."""
    names = _NAMES.findall(text)
    return next((part for scope, part in _SCOPES.items() if scope in names), "")


@lowering_for(PORTABLE)  # where all products are visible: fused attention is one operation
def count_macs(function: Any, *arguments: Any) -> "collections.Counter[str]":
    """Count the multiply-accumulates of a function's program, in products and convolutions.

    Args:
        function: a function of arrays.
        arguments: arrays, or their shapes (`jax.ShapeDtypeStruct`).

    Returns:
        The counts by model part; those of everything else have an empty name. Of a conditional,
        only the cheapest branch counts.

    Example:
        >>> import jax.numpy as jnp
        >>> count_macs(jnp.matmul, jnp.zeros((2, 3)), jnp.zeros((3, 4))).total()
        24
    """
    return _count(jax.make_jaxpr(function)(*arguments).jaxpr)


def _count(program: Any, scope: str = "", times: int = 1) -> "collections.Counter[str]":
    """Count the multiply-accumulates of each part in a program (a jaxpr)."""
    totals = collections.Counter[str]()
    for equation in program.eqns:
        here = f"{scope}/{equation.source_info.name_stack}"
        name = equation.primitive.name
        inside = times * equation.params["length"] if name == "scan" else times
        # Inner programs are among the parameters, closed or not; branches are a tuple of them.
        inner = [getattr(value, "jaxpr", value) for value in jax.tree.leaves(equation.params)]
        inner = [_count(each, here, inside) for each in inner if isinstance(each, core.Jaxpr)]
        if name == "cond":
            inner = [min(inner, key=collections.Counter.total)]
        for each in inner:
            totals.update(each)
        macs = times * _macs(equation, name, here)
        if macs:
            totals[_part_of(here)] += macs
    return totals


def _macs(equation: Any, name: str, scope: str) -> int:
    out = math.prod(equation.outvars[0].aval.shape) if equation.outvars else 0
    if name == "dot_general":
        (contracted, _), _ = equation.params["dimension_numbers"]
        left = equation.invars[0].aval.shape
        return out * math.prod(left[axis] for axis in contracted)
    if name == "conv_general_dilated":
        kernel = equation.invars[1].aval.shape
        channels = equation.params["dimension_numbers"].rhs_spec[0]
        return out * math.prod(kernel) // kernel[channels]
    # A depthwise convolution is implemented as products with its taps.
    return out if name == "mul" and TAPS in _NAMES.findall(scope) else 0


def adapter_macs(config: ModelConfig) -> int:
    """Count the multiply-accumulates per image that the adapter adds to one block."""
    backbone: Any = dataclasses.replace(config.backbone, depth=1)  # pyright: ignore
    shape = 1, 1 + backbone.registers + config.patches, backbone.dim
    tokens = jax.ShapeDtypeStruct(shape, jnp.float32)

    def count(backbone: Any) -> int:
        stacks = [jax.eval_shape(backbone.init, jax.random.key(0)).blocks]
        run = functools.partial(run_blocks, grid=config.grid, config=backbone)
        return count_macs(run, stacks, tokens).total()

    return count(backbone) - count(dataclasses.replace(backbone, adapter="none"))


def paper_adapter_macs(config: ModelConfig, macs: int) -> int:
    """Count an adapter's multiply-accumulates as the paper does (Table 3: 39.223 M).

    Its linear layers, `down` and `up`, count for one token only; the other layers are convolutions.

    Args:
        config: the model's configuration.
        macs: from `adapter_macs`, which counts a linear layer at every token instead.
    """
    backbone: Any = config.backbone
    weights = named_leaves(parameter_shapes(config).backbone.blocks.adapter).items()
    linears = sum(
        leaf.size for name, leaf in weights if f".{name}".endswith((".down.weight", ".up.weight"))
    )
    return macs - (backbone.registers + config.patches) * linears // backbone.depth
