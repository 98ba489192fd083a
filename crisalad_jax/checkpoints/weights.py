"""Read and write weight files: safetensors files with a model's arrays and configuration."""

import dataclasses
import hashlib
import json
import os
import pathlib
import re
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from crisalad_jax.checkpoints.safetensors_io import EXPECTED_WEIGHTS as EXPECTED
from crisalad_jax.checkpoints.safetensors_io import WEIGHTS as FORMAT
from crisalad_jax.checkpoints.safetensors_io import read_sealed, write_sealed
from crisalad_jax.config.checks import PATH, takes
from crisalad_jax.config.io import differences, from_plain, to_plain
from crisalad_jax.config.part import fingerprint_fields, with_non_semantic_fields_of
from crisalad_jax.config.plugins import changed_sources, sources_of
from crisalad_jax.config.short_repr import brief
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, Model, check_params, params_of
from crisalad_jax.utils.checksums import ChangedFileError
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import user_cache
from crisalad_jax.utils.output import warn, warn_once
from crisalad_jax.utils.pytree import named_leaves
from crisalad_jax.utils.version import VERSION

EXTRA = "extra."
"""Prefix of the names of arrays that only a conversion to a public checkpoint needs."""
LOSS = "loss."
"""Prefix of the names of a loss's parameters, which no descriptor needs."""


@dataclasses.dataclass(frozen=True)
class Header:
    """What a weight file records about its parameters."""

    config: ModelConfig
    version: str
    """Version of this package that wrote the file."""
    parts: dict
    """Name and source digest of every part, by its field (`config.plugins.sources_of`)."""
    model_sha256: str
    """The `model_hash` of the parameters."""
    aggregator: dict = dataclasses.field(default_factory=dict)
    """A field of earlier files, ignored."""
    loss: dict = dataclasses.field(default_factory=dict)
    """The run's `LossConfig` as JSON values, if the file has the loss's parameters; else empty."""
    restriction: str = ""
    """Notice of a licence that forbids commercial use; empty otherwise."""


@brief
class Checkpoint(NamedTuple):
    """A model that was read from a file, and what else the file holds."""

    params: Crisalad
    config: ModelConfig
    extras: dict[str, np.ndarray]
    """Arrays of a public checkpoint that no descriptor needs."""
    format: str | None = None
    """Public format of the file; None for a weight file of this package."""
    digest: str | None = None
    """The `model_hash` of the parameters; None for a public checkpoint."""
    loss: tuple[dict, dict[str, np.ndarray]] | None = None
    """`Header.loss` and the loss's parameters by name, if the file has them."""
    restriction: str = ""
    """`Header.restriction`, or for a public checkpoint `restriction_of` its format."""

    @property
    def model(self) -> Model:
        """The parameters and the configuration."""
        return Model(self.params, self.config)


@takes(path=PATH, model=Model)
def save_weights(
    path: str | os.PathLike[str],
    model: Model,
    *,
    extras: Mapping[str, np.ndarray] | None = None,
    half: bool = False,
    loss: tuple[Any, Any] | None = None,
    restriction: str = "",
) -> None:
    """Write a model as a safetensors file: arrays by dotted name, the configuration as metadata.

    Args:
        path: the .safetensors file.
        model: all parameters, and the configuration.
        extras: arrays of a public checkpoint that no descriptor needs, for converting it back.
        half: whether to store float32 parameters as float16, in half the space. They are rounded,
            and become float32 again when they are read.
        loss: the `LossConfig` of a run, and the loss's learnt parameters, for `load_loss`. The
            model and its digest do not depend on it.
        restriction: notice of a licence that forbids commercial use, shown when the file is loaded.

    Raises:
        InputError: the parameters do not fit the configuration or are not finite; the folder cannot
            be made, or the file cannot be written.

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
    params, config = model
    stored = params
    if half:
        stored = jax.tree.map(_halved, params)
        params = jax.tree.map(lambda leaf, half: half.astype(leaf.dtype), params, stored)
    check_params(params, config, stored=True)
    arrays = {name: np.asarray(leaf) for name, leaf in named_leaves(stored).items()}
    arrays |= {EXTRA + name: array for name, array in (extras or {}).items()}
    learnt = {} if loss is None else named_leaves(loss[1])
    arrays |= {LOSS + name: np.asarray(leaf) for name, leaf in learnt.items()}
    header = {
        "config": to_plain(config),
        "version": VERSION,
        "parts": sources_of(config),
        "model_sha256": model_hash(params, config),
        **({} if loss is None else {"loss": to_plain(loss[0])}),
        **({"restriction": restriction} if restriction else {}),
    }
    write_sealed(path, arrays, FORMAT, header)


def _halved(leaf: Any) -> np.ndarray:
    """Return a float32 array in half precision, and any other as it is."""
    array = np.asarray(leaf)
    if array.dtype != np.float32:
        return array
    with np.errstate(over="ignore"):  # infinity is reported as such
        return array.astype(np.float16)


def load_weights(
    path: str | os.PathLike[str], expected: ModelConfig | None = None, *, verify: bool = True
) -> Model:
    """Read the model that `save_weights` wrote.

    It warns if the source code of a plug-in's part has changed since the file was written.

    Args:
        path: the file; `find_weights` finds the file of a named model.
        expected: the configuration that the file must have; None allows any. Fields that parameters
            do not depend on may differ, such as image size (not MixVPR's), resize and dropout.
        verify: whether to check the file against its checksum.

    Returns:
        The model.

    Raises:
        InputError: the file is missing, changed, truncated or not a weight file; it needs a part
            that is not registered; its parameters do not fit its configuration or are not finite
            (the first that are missing, unknown or wrong are listed); its configuration is not
            `expected` (all fields that differ are listed).

    Example:
        >>> load_weights("none.safetensors")
        Traceback (most recent call last):
        ...
        crisalad_jax.utils.errors.InputError: none.safetensors: found no such file, expected ...
    """
    found = read_weights(path, verify=verify)
    if expected is not None:
        config = with_non_semantic_fields_of(expected, found.config)
        if config.aggregator.fixed_grid:
            config = dataclasses.replace(config, image_size=found.config.image_size)
        wrong = differences(config, expected)
        if wrong:
            raise InputError(f"{path}: these weights are of another model: {'; '.join(wrong)}")
    return found.model


def read_weights(path: str | os.PathLike[str], *, verify: bool = True) -> Checkpoint:
    """Read everything that `save_weights` wrote, with the arguments of `load_weights`.

    Raises:
        InputError: the file or its model is invalid, as for `load_weights` without `expected`.
    """
    try:
        value, arrays = read_sealed(path, FORMAT, EXPECTED, verify=verify)
    except ChangedFileError as error:
        is_cached = user_cache() in pathlib.Path(path).parents
        advice = "; remove it, and the same command makes it again" if is_cached else ""
        raise InputError(f"{error}{advice}") from error
    extras, learnt = (
        {n.removeprefix(prefix): arrays.pop(n) for n in list(arrays) if n.startswith(prefix)}
        for prefix in (EXTRA, LOSS)
    )
    check_sizes(value.get("config"), arrays.values(), str(path))
    header = from_plain(Header, value, source=f"{path} (metadata)")
    config = header.config
    for name, array in arrays.items():
        if array.dtype == np.float16:
            arrays[name] = array.astype(np.float32)
    params = params_of(arrays, config, source=str(path))
    changed = changed_sources(config, header.parts)
    if changed:
        warn(
            f"{path}: found another source of {', '.join(changed)} than these weights were written "
            "with; descriptors may differ"
        )
    loss = (header.loss, learnt) if header.loss else None
    restriction = header.restriction
    if restriction:
        warn_once(str(path), restriction)
    return Checkpoint(params, config, extras, None, header.model_sha256, loss, restriction)


def check_sizes(plain: Any, arrays: Collection[np.ndarray], source: str) -> None:
    """Check that the sizes in a file's configuration are plausible for the arrays in the file.

    Call it before making anything from the configuration: a file may claim any sizes.

    Args:
        plain: the configuration, as JSON values.
        arrays: all arrays in the file.
        source: the file, for messages.

    Raises:
        InputError: the configuration has more layers than arrays, or far larger sizes.
    """
    text = json.dumps(plain)
    layers = sum(map(int, re.findall(r'"layers": (\d+)', text)))
    largest = max(map(int, re.findall(r": (\d+)[,}]", text)), default=0)
    if layers > len(arrays) or largest > max(2**20, sum(array.size for array in arrays)):
        raise InputError(
            f"{source}: found {len(arrays)} arrays, far from the sizes in its configuration: "
            f"{layers} layers, and sizes of up to {largest}"
        )


def model_hash(params: Crisalad, config: ModelConfig) -> str:
    """Compute a digest of all that determines descriptors, except image size and rounding.

    It covers the names, types, shapes and values of the parameters, and the configuration's fields
    that outputs depend on and that differ from their defaults (for MixVPR also the image size). It
    is the same for a copy in another memory layout, and in a later version with more fields.

    Args:
        params: all parameters of the model.
        config: the model's configuration.

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
