"""Export a model as one StableHLO program, which runs without this package (`jax.export`).

An export is a folder. `describe.jax_export` is the program, and `manifest.json` describes its
inputs and outputs. `weights.safetensors` lies beside them unless the program holds the weights.
"""

import contextlib
import dataclasses
import os
import pathlib
from collections.abc import Iterator
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import export
from jaxtyping import Array, Float

from crisalad_jax.checkpoints.weights import model_hash, save_weights
from crisalad_jax.config.checks import check_types, choose
from crisalad_jax.config.io import to_plain
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, Images, check_params, describe, self_mask
from crisalad_jax.utils.checksums import sha256_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_folder, check_new_folder, write_json
from crisalad_jax.utils.pytree import named_leaves
from crisalad_jax.utils.target import PORTABLE, lowering_for

FORMAT = "crisalad-jax export 1"
PROGRAM, WEIGHTS, MANIFEST = "describe.jax_export", "weights.safetensors", "manifest.json"
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
"""Platforms that `jax.export` knows."""
GROUPINGS = {
    "single": "every image is described alone",
    "batch": "the images of a call look at each other",
}
_SOURCES = "jax_traceback_in_locations_limit"
"""JAX's setting: how many lines of source a program has beside each operation."""
_LARGEST = 2**31
"""Largest size of a program in bytes: a flatbuffer's offsets have 31 bits."""


@dataclasses.dataclass(frozen=True)
class ExportConfig:
    """The inputs and the platforms of an exported program.

    Example:
        >>> ExportConfig(platforms=("cpu",), batch_size=8).grouping
        'single'
    """

    grouping: Literal["single", "batch"] = "single"
    """Grouping of a call's images in the cross-image encoder: each alone, or the whole batch."""
    batch_size: int | None = None
    """Number of images in a call; None takes any number, by a symbolic dimension."""
    weights_inside: bool = False
    """Whether the program holds the weights as constants; else it takes them as an argument."""
    platforms: tuple[str, ...] = ("cpu", "cuda")

    def __post_init__(self) -> None:
        """Check the values."""
        check_types(self)
        choose("grouping", self.grouping, GROUPINGS)
        if self.batch_size is not None and self.batch_size < 1:
            raise InputError(f"batch size: found {self.batch_size}, expected at least 1")
        if not self.platforms:
            raise InputError(f"platforms: found none, expected some of {', '.join(PLATFORMS)}")
        for name in self.platforms:
            choose("platforms", name, dict.fromkeys(PLATFORMS))


def check_exportable(params: Crisalad, config: ModelConfig, how: ExportConfig) -> None:
    """Check that a model can be exported in this way, before the work of tracing it.

    Raises:
        InputError: parameters of another configuration; weights inside of 2 GiB or more; or
            transport that must converge.
    """
    check_params(params, config)
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(params))
    if how.weights_inside and size >= _LARGEST:
        raise InputError(
            f"weights inside: found {size / 2**30:.1f} GiB of parameters, expected less than "
            f"{_LARGEST / 2**30:g} GiB, all that a program can hold; leave them beside it"
        )
    sinkhorn = getattr(config.aggregator, "sinkhorn", None)
    if sinkhorn is not None and sinkhorn.throw:
        raise InputError(
            "SinkhornConfig.throw: found True, expected False: an exported program cannot "
            "stop with an error"
        )


def export_model(params: Crisalad, config: ModelConfig, how: ExportConfig) -> export.Exported:
    """Export the program of `(weights, images)`, or of `images` where the weights are inside.

    `images` are RGB (batch, height, width, 3) of `config.input_size`: 8-bit, or normalised float32
    where the model resizes floats. The result is their unit descriptors (batch, descriptor).
    `weights` is a dictionary of the arrays by their dotted
    names. Nothing in the program depends on the platform that exports it, nor on who calls this.

    Raises:
        InputError: as `check_exportable`.
    """
    check_exportable(params, config, how)
    # A dictionary's leaves come in the order of its keys, not in that of the fields.
    weights, tree = named_leaves(params), jax.tree.structure(params)

    def run(weights: dict[str, Array], images: Images) -> Float[Array, "image descriptor"]:
        restored = jax.tree.unflatten(tree, [weights[name] for name in named_leaves(params)])
        mask = self_mask(images.shape[0]) if how.grouping == "single" else None
        return describe(restored, images, config, mask=mask)

    batch = how.batch_size
    if batch is None:
        (batch,) = export.symbolic_shape("batch")
    dtype = jnp.uint8 if config.preprocessing.pixels == "bytes" else jnp.float32
    images = jax.ShapeDtypeStruct((batch, *config.input_size, 3), dtype)
    with lowering_for(PORTABLE), _without_sources():
        if how.weights_inside:
            whole = jax.jit(lambda images: run(weights, images))
            return export.export(whole, platforms=how.platforms)(images)
        shapes = {n: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for n, leaf in weights.items()}
        return export.export(jax.jit(run), platforms=how.platforms)(shapes, images)


@contextlib.contextmanager
def _without_sources() -> Iterator[None]:
    """Keep names and lines of source files out of programs: they differ by disk and by caller."""
    before = jax.config.values[_SOURCES]
    jax.config.update(_SOURCES, 0)
    try:
        yield
    finally:
        jax.config.update(_SOURCES, before)


def write_export(
    out: str | os.PathLike[str],
    params: Crisalad,
    config: ModelConfig,
    how: ExportConfig = ExportConfig(),
) -> dict[str, Any]:
    """Write a model as a program for any platform into the new folder `out`, whole or not at all.

    Args:
        out: the folder.
        params: the model's parameters.
        config: the model.
        how: platforms, batch size and grouping.

    Returns:
        The manifest, as manifest.json has it.

    Raises:
        InputError: as `check_exportable`; or `out` is a file, or a folder that holds something.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> how = ExportConfig(batch_size=2)
        >>> write_export(folder / "export", params, config, how)["descriptors"]["shape"]
        [2, 576]
    """
    check_new_folder(out)
    exported = export_model(params, config, how)
    with atomic_folder(out) as folder:
        (folder / PROGRAM).write_bytes(exported.serialize(vjp_order=0))
        if not how.weights_inside:
            save_weights(folder / WEIGHTS, params, config)
        manifest = _manifest(folder, exported, params, config, how)
        write_json(folder / MANIFEST, manifest)
    return manifest


def _manifest(
    folder: pathlib.Path,
    exported: export.Exported,
    params: Crisalad,
    config: ModelConfig,
    how: ExportConfig,
) -> dict[str, Any]:
    images, (descriptors,) = exported.in_avals[-1], exported.out_avals
    called = "images" if how.weights_inside else "weights, images"
    return {
        "format": FORMAT,
        "call": f"jax.export.deserialize(program).call({called})",
        "program": _file(folder / PROGRAM),
        "weights": None
        if how.weights_inside
        else _file(folder / WEIGHTS)
        | {"argument": "a dictionary of all arrays in the file by their names"},
        "images": {
            "shape": _shape(images),
            "dtype": str(images.dtype),
            **_chain(config),
        },
        "descriptors": {
            "shape": _shape(descriptors),
            "dtype": str(descriptors.dtype),
            "norm": "unit length (L2)" if config.unit_length else "any length",
        },
        "grouping": how.grouping,
        "grouping_means": GROUPINGS[how.grouping],
        "platforms": list(exported.platforms),
        "calling_convention_version": exported.calling_convention_version,
        "jax_version": jax.__version__,
        "model_sha256": model_hash(params, config),
        "model": to_plain(config),
    }


def _chain(config: ModelConfig) -> dict[str, Any]:
    """Tell how images are prepared for the program, which has one size, whatever the rule."""
    how = config.preprocessing
    values: dict[str, Any] = {
        "layout": "RGB, rows from the top, not normalised",
        "resize": "Pillow's BILINEAR to (height, width), aspect ratio not kept",
    }
    fixed = dataclasses.replace(how, size_rule="fixed", round_to_patch=False)
    if fixed.in_words(config.input_size) != PreprocessingConfig().in_words(config.input_size):
        values["resize"] = f"{fixed.in_words(config.input_size)}, aspect ratio not kept"
    if how.pixels == "floats":
        values["layout"] = "RGB, rows from the top, (pixels / 255 - mean) / deviation"
        values |= {"mean": list(how.mean), "deviation": list(how.deviation)}
    return values


def _shape(array: Any) -> list[int | str]:
    return [size if isinstance(size, int) else str(size) for size in array.shape]


def _file(path: pathlib.Path) -> dict[str, Any]:
    return {"file": path.name, "bytes": path.stat().st_size, "sha256": sha256_of(path)}
