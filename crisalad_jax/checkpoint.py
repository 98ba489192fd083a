"""Files of weights: safetensors, the configuration inside."""

import dataclasses
import hashlib
import json
import os
import pathlib
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import safetensors

from crisalad_jax.config import AGGREGATORS, ModelConfig
from crisalad_jax.errors import InputError
from crisalad_jax.files import check_source, write_safetensors
from crisalad_jax.model import Crisalad, parameter_shapes
from crisalad_jax.nn.aggregators.anyloc import AnyLoc, check_vocabulary
from crisalad_jax.pytree import named_leaves
from crisalad_jax.serial import differences, from_plain, to_plain

FORMAT = "crisalad-jax 1"
"""The one key of a weight file's metadata; its value is the configuration as JSON."""
EXTRA = "extra."
"""What names of arrays begin with that are kept for the way back to a public checkpoint alone."""

_FREE_OF_PARTS = (("salad", "dropout"), ("encoder", "dropout"))


def _free(config: ModelConfig) -> tuple[str, ...]:
    """What a model is asked for: the same parameters serve whatever these are.

    So they do whatever the aggregators are that it does not have.
    """
    other = (field for name, field in AGGREGATORS.items() if name != config.aggregator)
    size = () if config.one_size else ("image_size",)
    return (*size, "compute_dtype", "keeps", *other)


def save_weights(
    path: str | os.PathLike[str],
    params: Crisalad,
    config: ModelConfig,
    *,
    extras: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write parameters under their dotted names, and the configuration in the file's metadata.

    `extras` are arrays of a public checkpoint that no description needs (see `convert`).

    Raises:
        InputError: the folder cannot be made, or the file not be written; or AnyLoc's vocabulary is
            of another backbone.
    """
    _check_whole(params, str(path))
    arrays = {name: np.asarray(leaf) for name, leaf in named_leaves(params).items()}
    arrays |= {EXTRA + name: array for name, array in (extras or {}).items()}
    write_safetensors(path, arrays, {FORMAT: json.dumps(to_plain(config))})


def is_ours(path: str | os.PathLike[str]) -> bool:
    """Whether this is a whole safetensors file that `save_weights` wrote."""
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return FORMAT in (file.metadata() or {})
    except (safetensors.SafetensorError, OSError):
        return False


def load_extras(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The `extras` that `save_weights` wrote."""
    with safetensors.safe_open(path, framework="numpy") as file:
        names = [name for name in file.keys() if name.startswith(EXTRA)]  # noqa: SIM118
        return {name.removeprefix(EXTRA): file.get_tensor(name) for name in names}


def load_weights(
    path: str | os.PathLike[str], expected: ModelConfig | None = None
) -> tuple[Crisalad, ModelConfig]:
    """Read what `save_weights` wrote: (params, config).

    Args:
        path: the file.
        expected: if given, the configuration that the file must have, except for what parameters
            do not depend on: image size (but MixVPR's do), dropout, compute type, what is kept.

    Raises:
        InputError: the file is missing, cut short or no such file; its parameters do not fit its
            configuration or are not finite (all that are missing, unknown or wrong are listed); its
            configuration is not `expected` (all fields that differ are listed); or AnyLoc's
            vocabulary is of another backbone.
    """
    path = pathlib.Path(path)
    check_source(path, "a .safetensors file of weights")
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if FORMAT not in metadata:
                raise InputError(
                    f"{path}: found metadata {sorted(metadata)}, expected {FORMAT!r}, as this "
                    "package writes it; `crisalad convert` reads public checkpoints"
                )
            names = [name for name in file.keys() if not name.startswith(EXTRA)]  # noqa: SIM118
            found = {name: file.get_tensor(name) for name in names}
    except (safetensors.SafetensorError, OSError) as error:
        raise InputError(
            f"{path}: not a whole safetensors file: {error}; `crisalad convert` reads torch files"
        ) from error
    try:
        plain = json.loads(metadata[FORMAT])
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: found no configuration in its metadata: {error}") from error
    config = from_plain(ModelConfig, plain, source=f"{path} (metadata)")
    if expected is not None:
        wrong = differences(_with_free_fields_of(expected, config), expected)
        if wrong:
            raise InputError(f"{path}: these weights are of another model: {'; '.join(wrong)}")
    params = _fill(config, found, path)
    _check_whole(params, str(path))
    return params, config


def _check_whole(params: Crisalad, source: str) -> None:
    if isinstance(params.aggregator, AnyLoc):
        check_vocabulary(params.aggregator, params.backbone, source)


def _with_free_fields_of(other: ModelConfig, config: ModelConfig) -> ModelConfig:
    parts = {
        part: dataclasses.replace(
            getattr(config, part), **{field: getattr(getattr(other, part), field)}
        )
        for part, field in _FREE_OF_PARTS
    }
    parts |= {field: getattr(other, field) for field in _free(config)}
    return dataclasses.replace(config, **parts)


def _fill(config: ModelConfig, found: dict[str, np.ndarray], path: pathlib.Path) -> Crisalad:
    # Said before a template is made of sizes that any text may claim; small ones are listed below.
    largest = max(n for n in jax.tree.leaves(to_plain(config)) if type(n) is int)
    layers = config.encoder.layers + config.aggregator_layers
    if largest > max(2**20, sum(array.size for array in found.values())) or (
        layers > max(64, len(found))
    ):
        raise InputError(
            f"{path}: found {len(found)} arrays, far from the sizes that its configuration says, "
            f"of up to {largest}"
        )
    template = parameter_shapes(config)
    wanted = named_leaves(template)
    problems = [f"{name} missing" for name in wanted.keys() - found.keys()]
    problems += [f"{name} unknown" for name in found.keys() - wanted.keys()]
    for name, leaf in wanted.items():
        if name not in found:
            continue
        array = found[name]
        if (array.dtype, array.shape) != (leaf.dtype, leaf.shape):
            problems.append(
                f"{name} found {array.dtype} {array.shape}, expected {leaf.dtype} {leaf.shape}"
            )
        elif not np.isfinite(array).all():
            problems.append(f"{name} holds NaN or infinity")
    if problems:
        raise InputError(f"{path}: weights do not fit: {'; '.join(sorted(problems))}")
    leaves = [jnp.asarray(found[name]) for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def model_hash(params: Crisalad, config: ModelConfig) -> str:
    """A digest of everything that descriptors are a function of, besides image size and rounding.

    Of parameters by name, type, shape and value, and of the configuration without the image size
    (unless parameters belong to it), the type that is computed in, what is kept for the gradient,
    dropout, and aggregators that the model does not have: the same for a file of weights and for
    its copy in another layout.
    """
    plain = to_plain(config)
    for part, field in _FREE_OF_PARTS:
        plain[part].pop(field)
    for field in _free(config):
        plain.pop(field)
    digest = hashlib.sha256(json.dumps(plain, sort_keys=True).encode())
    for name, leaf in sorted(named_leaves(params).items()):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()
