"""Public torch checkpoints to files of this package, and back: reading and writing the files."""

import dataclasses
import json
import os
import pathlib
import pickle
import re
import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from crisalad_jax.checkpoint import is_ours, load_extras, load_weights, save_weights
from crisalad_jax.config import ModelConfig, ViTConfig, choose
from crisalad_jax.errors import InputError
from crisalad_jax.files import atomic_path, check_source, check_target, write_safetensors
from crisalad_jax.layouts import LAYOUTS, State, check_holds, infer, to_params, to_state
from crisalad_jax.model import Crisalad
from crisalad_jax.nn.vit import Block, ViT
from crisalad_jax.serial import differences, from_plain, to_plain

TORCH_SUFFIXES = (".pth", ".pt", ".ckpt")


class Checkpoint(NamedTuple):
    """A model from any file we can read."""

    params: Crisalad
    config: ModelConfig
    extras: dict[str, np.ndarray]
    layout: str | None
    """The public layout it was in; None for a file of this package."""


def read_checkpoint(path: str | os.PathLike[str]) -> Checkpoint:
    """Read a public checkpoint, or a file of this package. Half precision becomes float32, exactly.

    Torch files are read by `torch.load(weights_only=True)`: nothing in them is run.

    Raises:
        InputError: the file is missing, cut short, none of the layouts, asks to run code, or does
            not fit its layout (every name that is missing, unknown or misshaped is listed); or
            torch is needed and not installed.
    """
    path = pathlib.Path(path)
    check_source(path, "a checkpoint")
    if is_ours(path):
        params, config = load_weights(path)
        return Checkpoint(params, config, load_extras(path), None)
    try:
        with path.open("rb") as file:
            start = file.read(9)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    # Torch writes zip archives, and wrote plain pickles before; safetensors a length and a brace.
    if start[8:] == b"{" or (path.suffix == ".safetensors" and not start.startswith(b"PK")):
        content: Any = _read_safetensors(path)
    else:
        content = _read_torch(path)
    state, config = _unwrap(content, path)
    layout = "reference"
    if config is None:
        layout, config = infer(state, source=str(path))
    elif config.backbone.depth + config.encoder.layers + config.aggregator_layers > len(state):
        # Said before a table of names is made for a depth that any text may claim.
        raise InputError(
            f"{path}: found {len(state)} tensors, expected those of {config.backbone.depth} "
            f"blocks, {config.encoder.layers} encoder layers and {config.aggregator_layers} of the "
            "aggregator, as its configuration says"
        )
    state = {name: _float32(name, array, path) for name, array in state.items()}
    params, extras = to_params(state, config, layout, source=str(path))
    return Checkpoint(jax.tree.map(jnp.asarray, params), config, extras, layout)


def _read_safetensors(path: pathlib.Path) -> dict[str, np.ndarray]:
    try:
        return safetensors.numpy.load_file(path)
    except AttributeError as error:  # how it says that numpy has no such type
        raise InputError(f"{path}: found a type that numpy does not know: {error}") from error
    except (safetensors.SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a whole safetensors file: {error}") from error


def _read_torch(path: pathlib.Path) -> Any:
    torch = _torch(f"read {path}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of deprecated ways to write what is refused below
            content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        # Torch's message is a page of advice on how to run the code all the same.
        found = re.search(r"GLOBAL ([\w.]+)", str(error)) or re.search(
            r"Unsupported \w+ ([a-zA-Z_][\w.]*)", str(error)
        )
        what = f"asks for {found[1]}" if found else "is no plain pickle of tensors"
        raise InputError(
            f"{path}: refused: it {what}, expected nothing but tensors (loading anything else "
            "could run code)"
        ) from error
    except Exception as error:  # damaged pickles make it raise almost anything
        reason = str(error).split("\n")[0][:200] or type(error).__name__
        raise InputError(f"{path}: not a whole torch checkpoint: {reason}") from error

    def arrays(value: Any, name: object) -> Any:
        if isinstance(value, Mapping):
            return {key: arrays(item, key) for key, item in value.items()}
        if not isinstance(value, torch.Tensor):
            return value
        half = value.dtype in (torch.float16, torch.bfloat16)
        try:
            return (value.float() if half else value).detach().numpy()
        except (TypeError, RuntimeError) as error:  # sparse, quantised, eight bits, without data
            raise InputError(f"{path}: {name} is no plain tensor: {error}") from error

    return arrays(content, "its content")


def _torch(purpose: str) -> Any:
    try:
        import torch
    except ImportError as error:
        raise InputError(
            f"to {purpose} torch is needed and not installed: pip install torch"
        ) from error
    return torch


def _unwrap(content: Any, path: pathlib.Path) -> tuple[State, ModelConfig | None]:
    """The state inside a file's dictionary, and the configuration if our reference left one."""
    config = None
    for key in ("state_dict", "model_state_dict", "model"):
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            if isinstance(content.get("config"), str):
                config = from_plain(
                    ModelConfig, _json(content["config"], path), source=f"{path} (config)"
                )
            content = content[key]
            break
    if not isinstance(content, Mapping) or not content:
        found = "nothing" if isinstance(content, Mapping) else type(content).__name__
        raise InputError(f"{path}: found {found}, expected a dictionary of tensors by name")
    strange = [
        str(name)
        for name, value in content.items()
        if not isinstance(name, str) or not isinstance(value, np.ndarray)
    ]
    if strange:
        raise InputError(
            f"{path}: found {', '.join(sorted(strange))}, expected nothing but tensors by name"
        )
    if all(name.startswith("module.") for name in content):
        content = {name.removeprefix("module."): value for name, value in content.items()}
    return content, config


def _json(text: str, path: pathlib.Path) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: found no configuration under 'config': {error}") from error


def _float32(name: str, array: np.ndarray, path: pathlib.Path) -> np.ndarray:
    if name.endswith("num_batches_tracked"):
        if array.dtype != np.int64:
            raise InputError(f"{path}: {name} found {array.dtype}, expected int64")
        return array
    if array.dtype.name in ("float16", "bfloat16"):
        array = array.astype(np.float32)
    if array.dtype != np.float32:
        raise InputError(
            f"{path}: {name} found {array.dtype}, expected float32, float16 or bfloat16"
        )
    if not np.isfinite(array).all():
        raise InputError(f"{path}: {name} holds NaN or infinity")
    return array


def layout_for(config: ModelConfig, target: str | os.PathLike[str]) -> str:
    """The public layout that holds all of a model, or ours; a .safetensors is Hugging Face's."""
    if pathlib.Path(target).suffix == ".safetensors":
        return "huggingface"
    for layout in ("dinov2", "dino-salad", "cricavpr"):
        try:
            check_holds(config, layout)
        except InputError:
            continue
        return layout
    return "reference"


def write_checkpoint(
    path: str | os.PathLike[str],
    params: Crisalad,
    config: ModelConfig,
    layout: str,
    extras: State,
) -> None:
    """Write a model under public names, as published: nested, prefixed, in the public order.

    Raises:
        InputError: the layout cannot hold this model, the file cannot be made, or torch is needed
            and not installed.
    """
    path = pathlib.Path(path)
    names = choose("layout", layout, LAYOUTS)
    check_holds(config, layout, extras)
    state = to_state(params, config, layout, extras)
    if layout == "huggingface":
        write_safetensors(path, state, {"format": "pt"})
        return
    torch = _torch(f"write {path}")
    content: Any = {
        f"{names.module}{name}": torch.from_numpy(np.array(array)) for name, array in state.items()
    }
    if names.under is not None:
        content = {names.under: content}
    if layout == "reference":
        content["config"] = json.dumps(to_plain(config))
    # Through an open file, for torch writes the name of a path into the archive.
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        torch.save(content, file)


class Conversion(NamedTuple):
    """What was done: from which layout to which, None being this package's own."""

    source: str | None
    target: str | None
    config: ModelConfig


def convert(
    source: str | os.PathLike[str], target: str | os.PathLike[str], layout: str | None = None
) -> Conversion:
    """Public checkpoint to a file of this package, or such a file to a public checkpoint.

    Args:
        source: what `read_checkpoint` reads.
        target: for a public source, a .safetensors file. For one of ours, the public checkpoint.
        layout: one of `LAYOUTS`, for a source of ours; by default the one its parts came from.

    Raises:
        InputError: what `read_checkpoint` and `write_checkpoint` raise, or a target or layout that
            does not go with the source. Nothing is written then.
    """
    if layout is not None:
        choose("layout", layout, LAYOUTS)
    check_target(target)
    found = read_checkpoint(source)
    if pathlib.Path(target).exists() and os.path.samefile(source, target):
        raise InputError(f"{target}: found the source itself, expected another file")
    suffix = pathlib.Path(target).suffix
    if found.layout is None:
        layout = layout or layout_for(found.config, target)
        wanted = (".safetensors",) if layout == "huggingface" else TORCH_SUFFIXES
        if suffix not in wanted:
            raise InputError(
                f"{target}: found suffix {suffix!r}, expected {' or '.join(wanted)} for {layout}"
            )
        try:
            check_holds(found.config, layout, found.extras)
        except InputError as error:
            raise InputError(f"{source}: {error}") from error
        write_checkpoint(target, found.params, found.config, layout, found.extras)
        return Conversion(None, layout, found.config)
    if layout is not None:
        raise InputError(
            f"{source}: found a public checkpoint ({found.layout}) beside --layout {layout}, "
            "expected a file of this package; convert it to one first"
        )
    if suffix != ".safetensors":
        raise InputError(f"{target}: found suffix {suffix!r}, expected .safetensors")
    save_weights(target, found.params, found.config, extras=found.extras)
    return Conversion(found.layout, None, found.config)


def read_backbone(path: str | os.PathLike[str], config: ViTConfig, fresh: ViT) -> ViT:
    """The backbone of any checkpoint, for a model of `config`.

    Adapters come along if the file has just the same; otherwise they are those of `fresh`.

    Raises:
        InputError: what `read_checkpoint` raises, or the backbone is of another size (all fields
            that differ are listed).
    """
    found = read_checkpoint(path)
    theirs = found.config.backbone
    # How parameters start is nothing that weights depend on.
    free = {
        name: getattr(config, name) for name in ("position_start", "layer_scale_start", "adapter")
    }
    wrong = differences(dataclasses.replace(theirs, **free), config)
    if wrong:
        raise InputError(f"{path}: this backbone is of another size: {'; '.join(wrong)}")
    if theirs.adapter == config.adapter:
        return found.params.backbone
    stack, start = found.params.backbone.blocks, fresh.blocks
    assert isinstance(stack, Block)  # as read and as made: only training cuts the stack
    assert isinstance(start, Block)
    blocks = dataclasses.replace(stack, adapter=start.adapter)
    return dataclasses.replace(found.params.backbone, blocks=blocks)
