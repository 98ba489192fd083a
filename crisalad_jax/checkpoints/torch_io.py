"""Read and write public torch checkpoints, and convert them to this package's files and back."""

import collections
import dataclasses
import json
import os
import pathlib
import pickle
import re
import warnings
import zipfile
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from crisalad_jax.checkpoints.layouts import (
    LAYOUTS,
    State,
    check_holds,
    identify,
    public_shapes,
    renamed_to,
    to_params,
    to_state,
)
from crisalad_jax.checkpoints.layouts.anyloc import VOCABULARY, vocabulary_model
from crisalad_jax.checkpoints.matlab_io import MATLAB_SUFFIX, read_matlab, write_matlab
from crisalad_jax.checkpoints.safetensors_io import write_safetensors
from crisalad_jax.checkpoints.weights import (
    count_layers,
    is_ours,
    load_extras,
    load_weights,
    save_weights,
)
from crisalad_jax.config.checks import PATH, choose, takes
from crisalad_jax.config.io import differences, from_plain, to_plain
from crisalad_jax.config.part import with_non_semantic_fields_of
from crisalad_jax.config.short_repr import brief
from crisalad_jax.nn.aggregators.anyloc import AnyLoc
from crisalad_jax.nn.backbones import Backbone
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, Model
from crisalad_jax.utils.errors import InputError, few
from crisalad_jax.utils.files import atomic_path, check_source, check_target, is_html

SUFFIXES = {
    "torch": (".pth", ".pt", ".ckpt"),
    "safetensors": (".safetensors",),
    "matlab": (MATLAB_SUFFIX,),
}
"""Suffixes of files by `Layout.stored`."""


class _Unread:
    """A stand-in for an array of NumPy with the weights, such as the recalls of a training run.

    Torch refuses a whole file with one, and NumPy itself would run on bytes of the file.
    """

    def __init__(self, *_: Any) -> None:
        """Take what the array would be made of, and keep nothing."""

    def __setstate__(self, _: Any) -> None:
        """Take its numbers, and keep nothing."""


_NUMPY = (
    "numpy.dtype",
    "numpy.ndarray",
    *(
        f"numpy.{core}.multiarray.{name}"
        for core in ("core", "_core")  # before NumPy 2, and since
        for name in ("_reconstruct", "scalar")
    ),
)
"""What a pickled array or number of NumPy asks for."""
_HOW = "torch.save(model.state_dict(), FILE) writes a file of the weights alone"


def _stand_in(name: str) -> type:
    """Make a stand-in for any other class or function that a file names: a dictionary.

    Its making runs nothing of the file. Torch fills exactly this kind of dictionary with items, as
    of a `defaultdict`, and with attributes, as of an `argparse.Namespace`.
    """

    def new(_: type, *__: Any) -> Any:
        made = collections.OrderedDict()
        vars(made)["stands_for"] = name
        return made

    return type(name, (), {"__new__": new})


class _Dictionary(dict[Any, Any]):
    """A dictionary of a file."""

    stands_for: str | None = None
    """The class of the file that it was, if it was none of a dictionary."""
    settings: Any = None
    """The configuration as JSON, where the names and shapes do not show all of it."""


_SETTINGS = "crisalad-jax config"
"""Key of the configuration in the metadata of a public checkpoint that we write."""


@brief
class Checkpoint(NamedTuple):
    """A model from any file we can read."""

    params: Crisalad
    config: ModelConfig
    extras: dict[str, np.ndarray]
    layout: str | None
    """Public layout of the file; None for a file of this package."""


def read_checkpoint(path: str | os.PathLike[str], *, verify: bool = True) -> Checkpoint:
    """Read a public checkpoint, or a file of this package; half precision becomes float32 exactly.

    Torch files are read by `torch.load(weights_only=True)`, which runs no code of the file.

    Raises:
        InputError: the file is missing, cut short, none of the layouts, asks to run code, or does
            not fit its layout (the first names that are missing, unknown or misshaped are listed);
            or torch is needed and not installed.
    """
    path = pathlib.Path(path)
    check_source(path, "a checkpoint")
    with path.open("rb") as file:
        if is_html(file.read(512)):
            raise InputError(f"{path}: found a page of HTML, expected a checkpoint")
    if is_ours(path):
        params, config = load_weights(path, verify=verify)
        return Checkpoint(params, config, load_extras(path), None)
    content = _read(path)
    state, config = _unwrap(content, path)
    layout, metadata = "reference", {}
    if config is None:
        text = state.settings
        layout, config, state = identify(state, source=str(path))
        if text is not None:
            ours = from_plain(ModelConfig, _json(text, path), source=f"{path} ({_SETTINGS})")
            config = with_non_semantic_fields_of(ours, config)
    elif count_layers(config) > len(state):
        # Check before making a table of names: the file may claim any depth.
        raise InputError(
            f"{path}: found {len(state)} tensors, expected those of {count_layers(config)} blocks "
            "and layers, as its configuration says"
        )
    else:
        state = renamed_to(state, public_shapes(config, layout).keys())
        metadata = content.get("aggregator", {})
    state = {name: _float32(name, array, path) for name, array in state.items()}
    params, extras = to_params(state, config, layout, source=str(path))
    params = jax.tree.map(jnp.asarray, params)
    if metadata:
        own = config.aggregator.with_metadata(params.aggregator, metadata)
        config.aggregator.check_backbone(own, params.backbone, str(path))
        params = dataclasses.replace(params, aggregator=own)
    return Checkpoint(params, config, extras, layout)


def read_vocabulary(
    path: str | os.PathLike[str],
    backbone: str | os.PathLike[str],
    fields: Mapping[str, Any] | None = None,
) -> Checkpoint:
    """Read a published vocabulary of AnyLoc, one tensor by itself, beside its backbone.

    Args:
        path: the vocabulary.
        backbone: any checkpoint that `read_checkpoint` reads, whose backbone is taken.
        fields: settings of `AnyLocConfig` that no shape tells: `layer`, `facet`, `assignment`.

    Returns:
        A whole model.

    Raises:
        InputError: what `read_checkpoint` raises of either file; or a vocabulary that is no tensor
            of words by itself, or of words of another width than the backbone's features.
    """
    path = pathlib.Path(path)
    check_source(path, "a vocabulary")
    words = _read(path)
    if not isinstance(words, np.ndarray):
        raise InputError(
            f"{path}: found {'dict' if isinstance(words, dict) else type(words).__name__}, "
            "expected one tensor by itself, of a vocabulary's words"
        )
    words = _float32("the vocabulary", words, path)
    base = read_checkpoint(backbone)
    try:
        config = vocabulary_model(words, base.config, fields or {})
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    aggregator = config.aggregator.bind(AnyLoc(jnp.asarray(words)), base.params.backbone)
    params = Crisalad(base.params.backbone, aggregator, None)
    return Checkpoint(params, config, base.extras, VOCABULARY)


def _read(path: pathlib.Path) -> Any:
    """Read the content of a file of torch, safetensors or MATLAB, with numpy's arrays."""
    try:
        with path.open("rb") as file:
            start = file.read(9)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    # Torch files are zip archives, older ones pickles. safetensors begin with a length and a brace.
    if path.suffix == MATLAB_SUFFIX:
        network = read_matlab(path)
        state = _Dictionary(network.state)
        state.settings = network.settings
        return state
    if start[8:] == b"{" or (path.suffix == ".safetensors" and not start.startswith(b"PK")):
        return _read_safetensors(path)
    return _read_torch(path)


def _read_safetensors(path: pathlib.Path) -> _Dictionary:
    try:
        state = _Dictionary(safetensors.numpy.load_file(path))
        with safetensors.safe_open(path, framework="numpy") as file:
            state.settings = (file.metadata() or {}).get(_SETTINGS)
        return state
    except AttributeError as error:  # safetensors' error for a type that numpy lacks
        raise InputError(f"{path}: found a type that numpy does not know: {error}") from error
    except (safetensors.SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a whole safetensors file: {error}") from error


def _read_torch(path: pathlib.Path) -> Any:
    torch = _torch(f"read {path}")
    _check_archive(path)
    named: list[str] = []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about deprecated formats, which are refused below
            if zipfile.is_zipfile(path):
                named = torch.serialization.get_unsafe_globals_in_checkpoint(path)
            stand_ins = [(_stand_in(name), name) for name in named if name not in _NUMPY]
            stand_ins += [(_Unread, name) for name in _NUMPY]
            with torch.serialization.safe_globals(stand_ins):
                content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        # Torch's message is a page of advice on how to run the code anyway: shorten it.
        refused = re.search(r"GLOBAL ([\w.]+)", str(error)) or re.search(
            r"Unsupported \w+ ([a-zA-Z_][\w.]*)", str(error)
        )
        what = f"asks for {refused[1]}" if refused else "is no plain pickle of tensors"
        raise InputError(
            f"{path}: refused: it {what}, expected nothing but tensors (loading anything else "
            f"could run code): {_HOW}"
        ) from error
    except Exception as error:  # a damaged pickle may raise any exception
        reason = str(error).split("\n")[0][:200]
        reason = f"{type(error).__name__}: {reason}" if reason else type(error).__name__
        others = [name for name in named if name not in _NUMPY]
        if others:
            reason += f" (it has {', '.join(sorted(others)[:3])} with the weights: {_HOW})"
        raise InputError(f"{path}: not a whole torch checkpoint: {reason}") from error

    def arrays(value: Any, name: object) -> Any:
        if isinstance(value, dict):
            made = _Dictionary((key, arrays(item, key)) for key, item in dict.items(value))
            attributes = getattr(value, "__dict__", {})
            made.stands_for = attributes.get("stands_for")
            metadata = attributes.get("_metadata")  # as of any module's state_dict
            made.settings = dict.get(metadata, _SETTINGS) if isinstance(metadata, dict) else None
            return made
        if not isinstance(value, torch.Tensor):
            return value
        half = value.dtype in (torch.float16, torch.bfloat16)
        try:
            return (value.float() if half else value).detach().numpy()
        except (TypeError, RuntimeError) as error:  # sparse, quantised, 8-bit or meta tensors
            raise InputError(f"{path}: {name} is no plain tensor: {error}") from error

    return arrays(content, "its content")


def _check_archive(path: pathlib.Path) -> None:
    """Check that a torch archive is whole, and does not unpack to more than its own size.

    Torch stores tensors as they are, but reads compressed ones too: some kilobytes could fill any
    memory.

    Raises:
        InputError: it is cut short, or it does.
    """
    size = path.stat().st_size
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(each.file_size for each in archive.infolist())
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        with path.open("rb") as file:
            begins = file.read(4) == b"PK\3\4"
        if begins and isinstance(error, zipfile.BadZipFile):
            # Its table of contents is at the end; torch's own message is a page.
            raise InputError(
                f"{path}: not a whole torch checkpoint: found the beginning of one, {size} bytes "
                "without an end, as an unfinished download leaves it"
            ) from error
        return  # torch says what is wrong with it
    if unpacked > size:
        raise InputError(
            f"{path}: found an archive of {size} bytes that unpacks to {unpacked}, expected a "
            "torch checkpoint, whose tensors are not compressed"
        )


def _torch(purpose: str) -> Any:
    try:
        import torch
    except ImportError as error:
        raise InputError(
            f"to {purpose} torch is needed and not installed: pip install torch"
        ) from error
    return torch


def _unwrap(content: Any, path: pathlib.Path) -> tuple[_Dictionary, ModelConfig | None]:
    """Return the state in a file's dictionary, and the configuration if our reference wrote one."""
    config = None
    for key in ("state_dict", "model_state_dict", "model", "teacher"):
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            if isinstance(content.get("config"), str):
                config = from_plain(
                    ModelConfig, _json(content["config"], path), source=f"{path} (config)"
                )
            content = content[key]
            break
    if isinstance(content, np.ndarray):
        raise InputError(
            f"{path}: found one tensor by itself, of shape {content.shape}, expected a dictionary "
            "of tensors by name (a vocabulary needs its backbone: `crisalad convert --backbone`)"
        )
    if not isinstance(content, _Dictionary) or not content:
        kind = type(content).__name__
        if isinstance(content, _Dictionary):
            kind = content.stands_for or "nothing"
        raise InputError(f"{path}: found {kind}, expected a dictionary of tensors by name: {_HOW}")
    strange = [
        str(name)
        for name, value in content.items()
        if not isinstance(name, str) or not isinstance(value, np.ndarray)
    ]
    if strange:
        raise InputError(
            f"{path}: found {few(sorted(strange))}, expected nothing but tensors by name: {_HOW}"
        )
    return content, config


def _json(text: str, path: pathlib.Path) -> Any:
    try:
        return json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
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
    """Choose the public layout, stored as the target's suffix says, that holds the whole model."""
    suffix = pathlib.Path(target).suffix
    stored = next((kind for kind, suffixes in SUFFIXES.items() if suffix in suffixes), "torch")
    fallback = {"safetensors": "huggingface", "matlab": "netvlad-matlab"}.get(stored, "reference")
    for name, layout in LAYOUTS.items():
        if layout.stored == stored and name != fallback and not layout.bare:
            try:
                check_holds(config, name)
            except InputError:
                continue
            return name
    return fallback


def write_checkpoint(
    path: str | os.PathLike[str],
    params: Crisalad,
    config: ModelConfig,
    layout: str,
    extras: State,
) -> None:
    """Write a model under public names, as published: nested, prefixed, in the public order.

    A configuration that names and shapes do not show, such as another image size than the published
    one, is in the metadata of the state, where no other program looks.

    Raises:
        InputError: the layout cannot hold this model, the file cannot be made, or torch is needed
            and not installed.
    """
    path = pathlib.Path(path)
    names = choose("layout", layout, LAYOUTS)
    shown = check_holds(config, layout, extras)
    is_all = with_non_semantic_fields_of(config, shown) == shown
    settings = None if is_all else json.dumps(to_plain(config))
    metadata = {} if settings is None else {_SETTINGS: settings}
    state = to_state(params, config, layout, extras)
    if names.stored == "safetensors":
        write_safetensors(path, state, {"format": "pt"} | metadata)
        return
    if names.stored == "matlab":
        write_matlab(path, state, settings)
        return
    torch = _torch(f"write {path}")
    content: Any = {
        f"{names.module}{name}": torch.from_numpy(np.array(array)) for name, array in state.items()
    }
    if metadata:
        content = collections.OrderedDict(content)
        content._metadata = metadata
    if names.under is not None:
        content = {names.under: content}
    if names.bare:
        (content,) = content.values()
    if layout == "reference":
        content["config"] = json.dumps(to_plain(config))
        if own := config.aggregator.metadata(params.aggregator):
            content["aggregator"] = own
    # Pass an open file, because torch writes the name of a path into the archive.
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:  # torch's, after the disk's own
            reason = error.__context__ if isinstance(error.__context__, OSError) else error
            raise InputError(f"{path}: cannot be written: {str(reason).splitlines()[0]}") from error


class Conversion(NamedTuple):
    """A finished conversion: its source and target layouts, None for this package's own."""

    source: str | None
    target: str | None
    config: ModelConfig


@takes(source=PATH, target=PATH)
def convert(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    layout: str | None = None,
    *,
    backbone: str | os.PathLike[str] | None = None,
    fields: Mapping[str, Any] | None = None,
    half: bool = False,
) -> Conversion:
    """Convert a public checkpoint to a file of this package, or such a file to a public one.

    Args:
        source: what `read_checkpoint` reads.
        target: for a public source, a .safetensors file. For one of ours, the public checkpoint.
        layout: one of `LAYOUTS`, for a source of ours; by default the one its parts came from.
        backbone: the backbone's checkpoint, for a source that is a vocabulary of AnyLoc by itself.
        fields: see `read_vocabulary`.
        half: whether to write a file of this package in half precision, of a source of ours too;
            see `save_weights`.

    Returns:
        What was read and written.

    Raises:
        InputError: what `read_checkpoint` and `write_checkpoint` raise, or a target or layout that
            does not go with the source. Nothing is written then.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad, load, save_weights
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> save_weights(folder / "ours.safetensors", Model(params, config))
        >>> done = convert(folder / "ours.safetensors", folder / "public.pth", "reference")
        >>> load(folder / "public.pth").config == config
        True
    """
    if layout is not None:
        choose("layout", layout, LAYOUTS)
    check_target(target)
    if backbone is None:
        checkpoint = read_checkpoint(source)
    else:
        checkpoint = read_vocabulary(source, backbone, fields)
    if pathlib.Path(target).exists() and os.path.samefile(source, target):
        raise InputError(f"{target}: found the source itself, expected another file")
    suffix = pathlib.Path(target).suffix
    if checkpoint.layout is None and not half:
        layout = layout or layout_for(checkpoint.config, target)
        wanted = SUFFIXES[LAYOUTS[layout].stored]
        if suffix not in wanted:
            raise InputError(
                f"{target}: found suffix {suffix!r}, expected {' or '.join(wanted)} for {layout}"
            )
        try:
            check_holds(checkpoint.config, layout, checkpoint.extras)
        except InputError as error:
            raise InputError(f"{source}: {error}") from error
        write_checkpoint(target, checkpoint.params, checkpoint.config, layout, checkpoint.extras)
        return Conversion(None, layout, checkpoint.config)
    if layout is not None and half:
        raise InputError(f"layout: found {layout} with half precision, expected only one of them")
    if layout is not None:
        raise InputError(
            f"{source}: found a public checkpoint ({checkpoint.layout}) beside --layout {layout}, "
            "expected a file of this package; convert it to one first"
        )
    if suffix != ".safetensors":
        raise InputError(f"{target}: found suffix {suffix!r}, expected .safetensors")
    model = Model(checkpoint.params, checkpoint.config)
    save_weights(target, model, extras=checkpoint.extras, half=half)
    return Conversion(checkpoint.layout, None, checkpoint.config)


@takes(path=PATH)
def read_backbone(path: str | os.PathLike[str], config: Backbone, fresh: Any) -> Any:
    """Read the backbone of any checkpoint, for a model of `config`.

    Adapters are read if the file has the same kind and sizes; otherwise they are those of `fresh`.
    Of a ResNet with more stages the first ones are taken.

    Args:
        path: what `load` reads.
        config: the backbone of the model.
        fresh: parameters of such a backbone, whose adapters are taken where the file has none.

    Returns:
        The backbone's parameters.

    Raises:
        InputError: what `read_checkpoint` raises, or the backbone is another (all fields that
            differ are listed).

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad, save_weights
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> save_weights(folder / "model.safetensors", Model(params, config))
        >>> fresh = config.backbone.init(jax.random.key(1))
        >>> backbone = read_backbone(folder / "model.safetensors", config.backbone, fresh)
        >>> bool((backbone.cls_token == params.backbone.cls_token).all())
        True
    """
    checkpoint = read_checkpoint(path)
    theirs = checkpoint.config.backbone
    if type(theirs) is not type(config):
        raise InputError(
            f"{path}: found a backbone {theirs.part_name}, expected {config.part_name}"
        )
    theirs, params = config.adopt(theirs, checkpoint.params.backbone, fresh)
    # Ignore free fields, such as the initialisation: weights do not depend on them.
    wrong = differences(with_non_semantic_fields_of(config, theirs), config, "backbone")
    if wrong:
        raise InputError(f"{path}: this backbone is another than the model's: {'; '.join(wrong)}")
    return params


def with_backbone_of(
    params: Crisalad, config: ModelConfig, path: str | os.PathLike[str]
) -> Crisalad:
    """Return a model's parameters with the backbone of any checkpoint; see `read_backbone`."""
    backbone = read_backbone(path, config.backbone, params.backbone)
    return dataclasses.replace(params, backbone=backbone)
