"""Read and write public checkpoints, and convert them to this package's files and back."""

import dataclasses
import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from crisalad_jax.checkpoints.formats import (
    FORMATS,
    REFERENCE,
    VOCABULARY,
    State,
    check_holds,
    identify,
    public_shapes,
    renamed_to,
    to_params,
    to_state,
)
from crisalad_jax.checkpoints.matlab_io import MATLAB_SUFFIX, read_matlab
from crisalad_jax.checkpoints.published import restriction_of
from crisalad_jax.checkpoints.safetensors_io import (
    read_metadata,
    read_safetensors,
    write_safetensors,
)
from crisalad_jax.checkpoints.torch_io import (
    DECLARED,
    Content,
    read_tensor,
    read_torch,
    write_torch,
)
from crisalad_jax.checkpoints.weights import (
    FORMAT,
    Checkpoint,
    check_sizes,
    read_weights,
    save_weights,
)
from crisalad_jax.config.checks import PATH, choose, takes
from crisalad_jax.config.io import differences, from_plain, to_plain
from crisalad_jax.config.part import with_non_semantic_fields_of
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.vlad import AnyLocConfig, Words
from crisalad_jax.nn.backbones import Backbone
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import NoCrossImage
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_source, check_target, is_html, parse_json
from crisalad_jax.utils.output import warn_once

SUFFIXES = {"torch": (".pth", ".pt", ".ckpt"), "safetensors": (".safetensors",)}
"""Suffixes of files that can be written, by `Format.stored`."""


@dataclasses.dataclass(frozen=True)
class _Declared:
    """The description of the model in a public checkpoint that we write."""

    format: str
    config: ModelConfig
    aggregator: dict = dataclasses.field(default_factory=dict)
    """Found in earlier files; ignored."""


def read_checkpoint(path: str | os.PathLike[str], *, verify: bool = True) -> Checkpoint:
    """Read a public checkpoint, or a weight file of this package.

    Half precision becomes float32, which is exact. `torch.load(weights_only=True)` reads torch
    files, without running code in them. `verify` compares a weight file with its checksum.

    Raises:
        InputError: the file is missing, damaged or of unknown format, asks to run code, or does not
            fit its format (the first missing, unknown or misshaped names are listed).
        ModuleNotFoundError: torch is needed but not installed.
    """
    path = pathlib.Path(path)
    check_source(path, "a checkpoint")
    with path.open("rb") as file:
        start = file.read(512)
    if is_html(start):
        raise InputError(f"{path}: found a page of HTML, expected a checkpoint")
    # Torch files are zip archives, older ones pickles. Safetensors begin with a length and a brace.
    if path.suffix == MATLAB_SUFFIX:
        content = read_matlab(path)
    elif start[8:9] == b"{" or (path.suffix == ".safetensors" and not start.startswith(b"PK")):
        if FORMAT in read_metadata(path, "a checkpoint"):
            return read_weights(path, verify=verify)
        metadata, state = read_safetensors(path, "a checkpoint")
        content = Content(state, metadata.get(DECLARED))
    else:
        content = read_torch(path)
    source = str(path)
    if content.declared is None:
        name, config, state = identify(content.state, source=source)
    else:
        value = parse_json(content.declared, f"{source} ({DECLARED})", "a configuration")
        check_sizes(value, content.state.values(), source)
        declared = from_plain(_Declared, value, source=f"{source} ({DECLARED})")
        name, config = declared.format, declared.config
        state = renamed_to(content.state, public_shapes(config, name).keys())
    if content.mean is not None:
        chain = dataclasses.replace(config.preprocessing, mean=content.mean)
        config = dataclasses.replace(config, preprocessing=chain)
    state = {key: _float32(key, array, source) for key, array in state.items()}
    params, extras = to_params(state, config, name, source=source)
    params = jax.tree.map(jnp.asarray, params)
    if restriction := restriction_of(name):
        warn_once(source, restriction)
    return Checkpoint(params, config, extras, name, restriction=restriction)


def _float32(name: str, array: np.ndarray, source: str) -> np.ndarray:
    """Return an array in float32; batch counts stay integers."""
    is_count = name.endswith("num_batches_tracked")
    kinds = ["int64"] if is_count else ["float32", "float16", "bfloat16"]
    if array.dtype.name not in kinds:
        raise InputError(f"{source}: {name} found {array.dtype}, expected {' or '.join(kinds)}")
    if not np.isfinite(np.asarray(array, np.float32)).all():
        raise InputError(f"{source}: {name} holds NaN or infinity")
    return array if is_count else np.asarray(array, np.float32)


def read_vocabulary(
    path: str | os.PathLike[str],
    backbone: str | os.PathLike[str],
    fields: Mapping[str, Any] | None = None,
) -> Checkpoint:
    """Read a published AnyLoc vocabulary, which is a single tensor, and its backbone.

    Args:
        path: a torch file of one tensor, (words, width of the backbone's features).
        backbone: any checkpoint that `read_checkpoint` reads; only its backbone is used.
        fields: settings of `AnyLocConfig` that shapes don't show: `layer`, `facet`, `assignment`.

    Returns:
        A complete model, for images of any size, whose sides are rounded to whole patches.

    Raises:
        InputError: `read_checkpoint` cannot read the backbone's file; or the vocabulary's file is
            unreadable, or not a single tensor of words as wide as the backbone's features.
    """
    path = pathlib.Path(path)
    check_source(path, "a vocabulary")
    words = _float32("the vocabulary", read_tensor(path), str(path))
    base = read_checkpoint(backbone)
    width = base.config.backbone.dim
    if words.ndim != 2 or words.shape[1] != width or not len(words):
        found = f"found a tensor of shape {words.shape}"
        raise InputError(f"{path}: {found}, expected (words, {width}), for the backbone's width")
    config = vocabulary_model(len(words), base.config, fields or {})
    params = Crisalad(base.params.backbone, Words(jnp.asarray(words)), None)
    return Checkpoint(params, config, base.extras, VOCABULARY)


def vocabulary_model(words: int, model: ModelConfig, fields: Mapping[str, Any]) -> ModelConfig:
    """Return AnyLoc on `model`'s backbone: `words` clusters, `fields` as in `read_vocabulary`."""
    return dataclasses.replace(
        model,
        preprocessing=PreprocessingConfig(size_rule="native", pixels="floats"),
        aggregator=AnyLocConfig(clusters=words, **fields),
        cross_image=NoCrossImage(),
        projection=ProjectionConfig(),
    )


def format_for(config: ModelConfig, target: str | os.PathLike[str]) -> str:
    """Return the name of a format for `target`'s suffix that can hold the model, or a fallback."""
    is_safetensors = pathlib.Path(target).suffix in SUFFIXES["safetensors"]
    stored, fallback = ("safetensors", "huggingface") if is_safetensors else ("torch", REFERENCE)
    for name, each in FORMATS.items():
        if each.stored == stored and name != fallback and not each.bare:
            try:
                check_holds(config, name)
            except InputError:
                continue
            return name
    return fallback


def write_checkpoint(
    path: str | os.PathLike[str], params: Crisalad, config: ModelConfig, format: str, extras: State
) -> None:
    """Write a model as a public checkpoint, with the names, nesting and order of published files.

    Settings that names and shapes do not show, such as an image size other than the published one,
    are stored as metadata, which other programs ignore. `extras` are those of `Checkpoint`.

    Raises:
        InputError: the format does not exist, cannot hold this model, or has another suffix than
            `path`; or the file cannot be written.
        ModuleNotFoundError: torch is needed but not installed.
    """
    path = pathlib.Path(path)
    form = choose("format", format, FORMATS)
    wanted = SUFFIXES[form.stored]
    if path.suffix not in wanted:
        raise InputError(f"{path}: found suffix {path.suffix!r}, expected {' or '.join(wanted)}")
    shown = check_holds(config, format)
    is_shown = format != REFERENCE and with_non_semantic_fields_of(config, shown) == shown
    declared = {"format": format, "config": to_plain(config)}
    text = None if is_shown else json.dumps(declared)
    state = to_state(params, config, format, extras)
    if form.stored == "safetensors":
        metadata = {} if text is None else {DECLARED: text}
        write_safetensors(path, state, {"format": "pt"} | metadata)
    else:
        under, _, module = form.inside.partition("/")
        named = {f"{module}{name}": array for name, array in state.items()}
        write_torch(path, named, under=under, bare=form.bare, declared=text)


class Conversion(NamedTuple):
    """A finished conversion: both formats (None for this package's) and the model's `config`."""

    source: str | None
    target: str | None
    config: ModelConfig


@takes(source=PATH, target=PATH)
def convert(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    format: str | None = None,
    *,
    backbone: str | os.PathLike[str] | None = None,
    fields: Mapping[str, Any] | None = None,
    half: bool = False,
) -> Conversion:
    """Convert a public checkpoint to a weight file of this package, or the reverse.

    Args:
        source: a public checkpoint (docs/how-to/use-public-checkpoints.md), or a weight file of
            this package.
        target: the file to write: a public checkpoint if the source is a weight file and `half` is
            not set; otherwise a weight file of this package (.safetensors).
        format: name of the public format to write, such as "reference"; None chooses one that fits.
        backbone: the backbone's checkpoint, for a source that is only an AnyLoc vocabulary.
        fields: settings of such a vocabulary: `layer`, `facet`, `assignment` of `AnyLocConfig`.
        half: whether to write a weight file in float16, from either kind of source.

    Returns:
        The formats of source and target, and the model's configuration.

    Raises:
        InputError: the source cannot be read, the model does not fit the format, or the target or
            format does not match the source. Nothing is written in that case.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, Model, init_crisalad, load, save_weights
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> save_weights(folder / "ours.safetensors", Model(params, config))
        >>> done = convert(folder / "ours.safetensors", folder / "public.pth", "reference")
        >>> load(folder / "public.pth").config == config
        True
    """
    check_target(target)
    if backbone is None:
        checkpoint = read_checkpoint(source)
    else:
        checkpoint = read_vocabulary(source, backbone, fields)
    if pathlib.Path(target).exists() and os.path.samefile(source, target):
        raise InputError(f"{target}: found the source itself, expected another file")
    config, found = checkpoint.config, checkpoint.format
    if found is None and not half:
        format = format or format_for(config, target)
        write_checkpoint(target, checkpoint.params, config, format, checkpoint.extras)
        return Conversion(None, format, config)
    if format is not None:
        kind = "half precision" if found is None else f"a public checkpoint ({found})"
        raise InputError(
            f"{source}: found {kind} and format {format}, expected a format only for a file of "
            "this package, in full precision"
        )
    check_target(target, ".safetensors")
    extras, restriction = checkpoint.extras, checkpoint.restriction
    save_weights(target, checkpoint.model, extras=extras, half=half, restriction=restriction)
    return Conversion(found, None, config)


@takes(path=PATH)
def read_backbone(path: str | os.PathLike[str], config: Backbone, fresh: Any) -> Any:
    """Read the backbone of any checkpoint, for a model with the backbone `config`.

    Adapters in the file are used if they have the kind and sizes of `config`; otherwise those of
    `fresh` are. If the file's ResNet has more stages than `config`, the first ones are used.

    Args:
        path: a public checkpoint (docs/how-to/use-public-checkpoints.md), or a weight file of
            this package.
        config: configuration of the model's backbone.
        fresh: parameters of a backbone with that configuration, such as `config.init` makes.

    Returns:
        The backbone's parameters.

    Raises:
        InputError: the file cannot be read, or has a different backbone (all fields that differ
            are listed).

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, Model, init_crisalad, save_weights
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> save_weights(folder / "model.safetensors", Model(params, config))
        >>> fresh = config.backbone.init(jax.random.key(1))
        >>> backbone = read_backbone(folder / "model.safetensors", config.backbone, fresh)
        >>> bool((backbone.cls_token == params.backbone.cls_token).all())
        True
    """
    checkpoint = read_checkpoint(path)
    theirs, params = checkpoint.config.backbone, checkpoint.params.backbone
    if type(theirs) is type(config):
        theirs, params = config.adapt_checkpoint(theirs, params, fresh)
    # Ignore non-semantic fields, such as the initialisation: weights do not depend on them.
    wrong = differences(with_non_semantic_fields_of(config, theirs), config, "backbone")
    if wrong:
        raise InputError(f"{path}: this backbone differs from the model's: {'; '.join(wrong)}")
    return params


def with_backbone_of(
    params: Crisalad, config: ModelConfig, path: str | os.PathLike[str]
) -> Crisalad:
    """Return a model's parameters, but with the backbone that `read_backbone` reads from `path`."""
    backbone = read_backbone(path, config.backbone, params.backbone)
    return dataclasses.replace(params, backbone=backbone)
