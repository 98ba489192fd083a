"""Random checkpoints in the public layouts, shared by the tests of conversion."""

import json
import pathlib
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import safetensors.torch
import torch

from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig

LAYOUTS = pathlib.Path(__file__).parents[1] / "parity" / "layouts"
UNDER = "model_state_dict/"
"""What the stored layout of CricaVPR writes before the names inside that dictionary."""


def bare_vit(depth: int = 2, position_grid: int = 2) -> ModelConfig:
    """A small DINOv2 by itself, of width 64."""
    backbone = ViTConfig(
        dim=64,
        depth=depth,
        heads=1,
        position_grid=position_grid,
        adapter="none",
    )
    return ModelConfig(aggregator="class-token", backbone=backbone, cross_image="none")


def public_layout(name: str) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a public checkpoint, in its order."""
    shapes = json.loads((LAYOUTS / f"{name}.json").read_text(encoding="utf-8"))
    return {key: tuple(shape) for key, shape in shapes.items()}


def fewer_blocks(shapes: dict[str, tuple[int, ...]], depth: int) -> dict[str, tuple[int, ...]]:
    """The layout of a model that ends after `depth` blocks."""

    def stays(name: str) -> bool:
        found = re.search(r"blocks\.(\d+)\.", name)
        return found is None or int(found[1]) < depth

    return {name: shape for name, shape in shapes.items() if stays(name)}


def narrow(shapes: dict[str, tuple[int, ...]], by: int) -> dict[str, tuple[int, ...]]:
    """The layout of a model of 1 / `by` of the backbone's width 768, with 2 x 2 positions.

    Clusters, patches and filters keep their sizes.
    """
    widths = {768, 2304, 3072, 384, 192, 96, 24}

    def size(name: str, number: int) -> int:
        if number == 1370:
            return 5
        head = name.startswith("aggregator.") and number != 768
        return number if head or number not in widths else number // by

    return {name: tuple(size(name, number) for number in shape) for name, shape in shapes.items()}


def blank(shapes: Mapping[str, Sequence[int]]) -> dict[str, np.ndarray]:
    """Arrays of these shapes, which take no memory."""
    return {name: np.broadcast_to(np.float32(0), tuple(shape)) for name, shape in shapes.items()}


def random_state(shapes: dict[str, tuple[int, ...]], seed: int = 0) -> dict[str, torch.Tensor]:
    """Every tensor of a layout at random, the type and range that torch would have it in."""
    generator = torch.Generator().manual_seed(seed)
    state = {}
    for name, shape in shapes.items():
        if name.endswith("num_batches_tracked"):
            state[name] = torch.randint(1, 1000, shape, generator=generator)
        elif name.endswith("running_var"):
            state[name] = 0.5 + torch.rand(shape, generator=generator)
        elif name.endswith(".p"):
            state[name] = 2.5 + torch.rand(shape, generator=generator)
        else:
            state[name] = 0.02 * torch.randn(shape, generator=generator)
    return state


def nested(state: dict[str, torch.Tensor]) -> dict[str, Any]:
    """The file's dictionary: CricaVPR's names hold the way to them."""
    if all(name.startswith(UNDER) for name in state):
        return {UNDER[:-1]: {name.removeprefix(UNDER): x for name, x in state.items()}}
    return dict(state)


def save(path: pathlib.Path, content: dict[str, Any]) -> pathlib.Path:
    """Write as the public tools do: torch's zip, or a safetensors file."""
    if path.suffix == ".safetensors":
        safetensors.torch.save_file(content, path, metadata={"format": "pt"})
    else:
        # Through an open file, or torch writes the path's name into the archive.
        with path.open("wb") as file:
            torch.save(content, file)
    return path


def same_bits(first: Any, second: Any) -> bool:
    """Whether two trees of dictionaries hold the same names in order, types, shapes and bits."""
    if isinstance(first, dict):
        return list(first) == list(second) and all(same_bits(first[k], second[k]) for k in first)
    first, second = first.numpy(), second.numpy()
    return (first.dtype, first.shape, first.tobytes()) == (
        second.dtype,
        second.shape,
        second.tobytes(),
    )


def as_arrays(state: dict[str, torch.Tensor]) -> dict[str, np.ndarray]:
    """The state as numpy arrays."""
    return {name: tensor.numpy() for name, tensor in state.items()}
