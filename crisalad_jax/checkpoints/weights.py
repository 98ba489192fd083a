"""Read and write files of weights: safetensors with the configuration and its parts' sources."""

import dataclasses
import hashlib
import json
import os
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np
import safetensors

from crisalad_jax.checkpoints.safetensors_io import read_sealed, write_sealed
from crisalad_jax.config.io import differences, from_plain, to_plain
from crisalad_jax.config.part import fingerprint_fields, with_non_semantic_fields_of
from crisalad_jax.config.plugins import changed_sources, sources_of
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.misfits import misfits, not_finite
from crisalad_jax.nn.model import Crisalad, Model, check_params, parameter_shapes
from crisalad_jax.utils.checksums import ChangedFileError, checked_safetensors
from crisalad_jax.utils.errors import InputError, few
from crisalad_jax.utils.files import check_source, is_html
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.pytree import named_leaves
from crisalad_jax.utils.version import VERSION

FORMAT = "crisalad-jax 3"
"""Only key of a weight file's metadata. Its value is JSON: the file's checksum, the configuration,
the version of this package, and the name and source's digest of every part."""
_DIGEST = "model_sha256"
"""Key of the `model_hash` in the metadata."""
_KINDS = {
    **dict.fromkeys(("config", "parts", "aggregator"), dict),
    **dict.fromkeys(("version", _DIGEST), str),
}
"""Types of the metadata's values."""
EXTRA = "extra."
"""Prefix of the names of arrays that only a conversion to a public checkpoint needs."""


def save_weights(
    path: str | os.PathLike[str],
    model: Model,
    *,
    extras: Mapping[str, np.ndarray] | None = None,
    half: bool = False,
) -> None:
    """Write parameters under their dotted names, and the configuration in the file's metadata.

    Args:
        path: the file, a .safetensors.
        model: all parameters, and the configuration.
        extras: arrays of a public checkpoint that no descriptor needs (see `convert`).
        half: whether to keep float32 parameters as float16, in half the room. They are rounded, and
            are float32 again when they are read.

    Raises:
        InputError: parameters that `load_weights` would refuse; the folder cannot be made, or the
            file not be written; or AnyLoc's vocabulary is of another backbone.

    Example:
        >>> import jax, tempfile
        >>> from crisalad_jax import PRESETS, Model, init_crisalad, load
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_weights(f"{folder}/w.safetensors", model)
        ...     loaded = load(f"{folder}/w.safetensors")
        >>> loaded.config == config
        True
    """
    if not isinstance(model, tuple):
        raise InputError(f"model: found {type(model).__name__}, expected a Model(params, config)")
    params, config = model
    check_params(params, config, stored=True)
    stored = params
    if half:
        stored = jax.tree.map(_halved, params)
        params = jax.tree.map(lambda leaf, half: half.astype(leaf.dtype), params, stored)
        check_params(params, config, stored=True)
    config.aggregator.check_backbone(params.aggregator, params.backbone, str(path))
    arrays = {name: np.asarray(leaf) for name, leaf in named_leaves(stored).items()}
    arrays |= {EXTRA + name: array for name, array in (extras or {}).items()}
    metadata = {
        "config": to_plain(config),
        "version": VERSION,
        "parts": sources_of(config),
        "aggregator": config.aggregator.metadata(params.aggregator),
        _DIGEST: model_hash(params, config),
    }
    write_sealed(path, arrays, FORMAT, metadata)


def _halved(leaf: Any) -> np.ndarray:
    """Return a float32 array in half precision, and any other as it is."""
    array = np.asarray(leaf)
    if array.dtype != np.float32:
        return array
    with np.errstate(over="ignore"):  # infinity is told of as such
        return array.astype(np.float16)


def is_ours(path: str | os.PathLike[str]) -> bool:
    """Return whether this is a whole safetensors file that `save_weights` wrote."""
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return FORMAT in (file.metadata() or {})
    except (safetensors.SafetensorError, OSError):
        return False


CACHE_RECORD = "record.json"
"""File beside the weights of a published model in the cache (`checkpoints.cache`)."""


def load_extras(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Return the `extras` that `save_weights` wrote."""
    with safetensors.safe_open(path, framework="numpy") as file:
        names = [name for name in file.keys() if name.startswith(EXTRA)]  # noqa: SIM118
        return {name.removeprefix(EXTRA): file.get_tensor(name) for name in names}


def load_weights(
    path: str | os.PathLike[str], expected: ModelConfig | None = None, *, verify: bool = True
) -> Model:
    """Read the model that `save_weights` wrote.

    A note tells if a part's source has changed since the weights were written.

    Args:
        path: the file.
        expected: if given, the configuration that the file must have, except for what parameters
            do not depend on: image size (but MixVPR's do), dropout, compute type, remat.
        verify: whether to check that the file's bytes are those that were written.

    Returns:
        The model.

    Raises:
        InputError: the file is missing, changed, cut short or no such file; it needs a part that is
            not registered; its parameters do not fit its configuration or are not finite (the first
            that are missing, unknown or wrong are listed); its configuration is not `expected` (all
            fields that differ are listed); or AnyLoc's vocabulary is of another backbone.

    Example:
        >>> load_weights("none.safetensors")
        Traceback (most recent call last):
        ...
        crisalad_jax.utils.errors.InputError: none.safetensors: found no such file, expected ...
    """
    params, config, _ = _loaded(path, expected, verify=verify)
    return Model(params, config)


def load_with_hash(path: str | os.PathLike[str]) -> tuple[Crisalad, ModelConfig, str]:
    """Read what `load_weights` reads, and the `model_hash` of the parameters as they were written.

    The file's checksum covers both.

    Raises:
        InputError: what `load_weights` raises.
    """
    params, config, metadata = _loaded(path, None, verify=True)
    return params, config, metadata[_DIGEST]


def _loaded(
    path: str | os.PathLike[str], expected: ModelConfig | None, *, verify: bool
) -> tuple[Crisalad, ModelConfig, dict[str, Any]]:
    """Read parameters, configuration and the rest of the metadata, and tell of changed sources."""
    path = pathlib.Path(path)
    try:
        with checked_safetensors(path, verify=verify):
            params, config, metadata = _load(path, expected)
    except ChangedFileError as error:
        if not path.with_name(CACHE_RECORD).is_file():
            raise
        raise InputError(
            f"{error}; it is in the cache: once it is removed, the same command makes it anew"
        ) from error
    changed = changed_sources(config, metadata["parts"])
    if changed:
        warn(
            f"{path}: found another source of {', '.join(changed)} than these weights were written "
            "with; descriptors may differ"
        )
    return params, config, metadata


def _load(
    path: pathlib.Path, expected: ModelConfig | None
) -> tuple[Crisalad, ModelConfig, dict[str, Any]]:
    """Read parameters, configuration and the rest of the metadata; see `load_weights`."""
    arrays, metadata = _read(path)
    config = from_plain(ModelConfig, metadata["config"], source=f"{path} (metadata)")
    if expected is not None:
        wrong = differences(_as_free_as(expected, config), expected)
        if wrong:
            raise InputError(f"{path}: these weights are of another model: {'; '.join(wrong)}")
    params = _fill(config, arrays, path)
    own = config.aggregator.with_metadata(params.aggregator, metadata["aggregator"])
    params = dataclasses.replace(params, aggregator=own)
    config.aggregator.check_backbone(params.aggregator, params.backbone, str(path))
    return params, config, metadata


def _read(path: pathlib.Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read the arrays by name, and the metadata."""
    expected = (
        f"a .safetensors file of weights ({FORMAT!r}), as this package writes it; `crisalad "
        "convert` reads public checkpoints"
    )
    _check_not_public(path, expected)
    plain, arrays = read_sealed(path, FORMAT, expected, but=EXTRA)
    for name, kind in _KINDS.items():
        if not isinstance(value := plain.get(name), kind):
            raise InputError(
                f"{path} (metadata): found {name} of {type(value).__name__}, expected "
                f"{kind.__name__}"
            )
    pairs = {field: pair for field, pair in plain["parts"].items() if _is_pair(pair)}
    return arrays, plain | {"parts": pairs}


_BEGINNINGS = {b"PK\3\4": "a torch file", b"\x80\2": "a torch file", b"MATLAB": "a MATLAB file"}
"""What files of public checkpoints begin with; torch's are archives, older ones pickles."""


def _check_not_public(path: pathlib.Path, expected: str) -> None:
    """Check that a file is not plainly one that `crisalad convert` reads.

    Raises:
        InputError: it is.
    """
    check_source(path, expected)
    try:
        with path.open("rb") as file:
            start = file.read(512)
    except OSError:
        return  # the reader tells
    if is_html(start):
        raise InputError(f"{path}: found a page of HTML, expected {expected}")
    kind = next((what for mark, what in _BEGINNINGS.items() if start.startswith(mark)), None)
    ours = path.with_suffix(".safetensors")
    if kind is None and _is_of_another_program(path):
        kind, ours = "a .safetensors file of another program", path.with_stem(f"{path.stem}-ours")
    if kind is not None:
        raise InputError(
            f"{path}: found {kind}, expected {expected}: crisalad convert {path} {ours}"
        )


def _is_of_another_program(path: pathlib.Path) -> bool:
    """Return whether a file is a whole one of safetensors, and of no format of this package."""
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return not any(key.startswith("crisalad-jax ") for key in file.metadata() or {})
    except (safetensors.SafetensorError, OSError):
        return False


def _is_pair(value: Any) -> bool:
    """Return whether this is a part's name and its source's digest."""
    return isinstance(value, list) and len(value) == 2


def _as_free_as(expected: ModelConfig, config: ModelConfig) -> ModelConfig:
    free = with_non_semantic_fields_of(expected, config)
    if config.aggregator.fixed_grid:
        free = dataclasses.replace(free, image_size=config.image_size)
    return free


def _fill(config: ModelConfig, arrays: dict[str, np.ndarray], path: pathlib.Path) -> Crisalad:
    # Check before making a template: the file may claim any sizes. Small misfits are listed below.
    largest = max(number for _, number in _whole_numbers(to_plain(config)))
    layers = count_layers(config) - config.backbone.depth
    if largest > max(2**20, sum(array.size for array in arrays.values())) or (
        layers > max(64, len(arrays))
    ):
        raise InputError(
            f"{path}: found {len(arrays)} arrays, far from the sizes that its configuration says, "
            f"of up to {largest}"
        )
    template = parameter_shapes(config)
    wanted = named_leaves(template)
    halves = {name: array for name, array in arrays.items() if array.dtype == np.float16}
    arrays |= {name: array.astype(np.float32) for name, array in halves.items()}
    problems = misfits(arrays, wanted) or not_finite(arrays)
    if problems:
        raise InputError(f"{path}: weights do not fit: {few(problems)}")
    # Not the file's own memory, which another program may change, and copied when this returns.
    leaves = [jax.device_put(arrays[name], may_alias=False) for name in wanted]
    jax.block_until_ready(leaves)
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def count_layers(config: ModelConfig) -> int:
    """Count the layers with parameters that a configuration asks for."""
    numbers = _whole_numbers(to_plain(config))
    return sum(number for name, number in numbers if name.endswith((".layers", ".depth")))


def _whole_numbers(plain: Any, name: str = "") -> Iterator[tuple[str, int]]:
    """Yield all whole numbers of a configuration by their dotted names."""
    if isinstance(plain, Mapping):
        for key, value in plain.items():
            yield from _whole_numbers(value, f"{name}.{key}")
    elif type(plain) is int:
        yield name, plain


def model_hash(params: Crisalad, config: ModelConfig) -> str:
    """Compute a digest of all that determines descriptors, besides image size and rounding.

    The digest covers the parameters' names, types, shapes and values. It also covers the
    configuration's fields that outputs depend on, if they differ from their defaults. It is the
    same for a copy in another layout, and for a version of this package with more fields.

    Args:
        params: all parameters of the model.
        config: the model.

    Returns:
        SHA-256 in hexadecimal digits.
    """
    plain = fingerprint_fields(config)
    if config.aggregator.fixed_grid:
        plain["image_size"] = list(config.image_size)
    digest = hashlib.sha256(json.dumps(plain, sort_keys=True).encode())
    for name, leaf in sorted(named_leaves(params).items()):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()
