"""Export a model as a program that runs without this package: StableHLO, ONNX or OpenVINO.

An export is a folder with the program and a `manifest.json` that describes its inputs and outputs.
The weights are in a separate file unless the program contains them. `jax.export` makes StableHLO
programs and `onnx_format` ONNX programs, which OpenVINO can convert to its own format.
"""

import dataclasses
import hashlib
import os
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import Array, Bool, Float

from crisalad_jax.checkpoints import engines
from crisalad_jax.checkpoints.engines import convert_to_openvino, load_program
from crisalad_jax.checkpoints.runtime import ATTEND, DESCRIBE, FORMAT, MANIFEST, TOKENS
from crisalad_jax.checkpoints.weights import model_hash, save_weights
from crisalad_jax.config.checks import PATH, check_count, check_types, takes
from crisalad_jax.config.io import to_plain
from crisalad_jax.config.preprocessing import IMAGENET_DEVIATION, IMAGENET_MEAN
from crisalad_jax.config.short_repr import short_repr
from crisalad_jax.data.prepare import normalised
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import (
    Crisalad,
    Images,
    Model,
    attend_across_images,
    check_params,
    describe,
    extract_tokens,
    self_mask,
)
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.checksums import sha256_of
from crisalad_jax.utils.compiler import number_types
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_folder, check_new_folder, write_json
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.pytree import named_leaves
from crisalad_jax.utils.target import PORTABLE, STRAIGHT, jax_setting, lowering_for

PROGRAM, WEIGHTS = "describe.jax_export", "weights.safetensors"
FORMATS = ("stablehlo", *engines.FORMATS)
TOLERANCE = 1e-5
"""Largest allowed difference from `describe` in an element of a descriptor of unit length."""
GROUPINGS = {
    "single": "every image is described independently",
    "batch": "the images of a call attend to each other",
    "any": "images are described together as a mask says",
}
_SOURCES = "jax_traceback_in_locations_limit"
"""JAX's setting: how many source locations a program stores with each operation; none in ours, as
they depend on the path and the caller."""
_LARGEST = 2**31
"""Largest size of a program in bytes: flatbuffer and protobuf offsets have 31 bits."""
_PROBES = 3
"""Number of images to check a program with, if it takes any number."""


@short_repr()
@dataclasses.dataclass(frozen=True)
class ExportConfig:
    """The format, inputs and platforms of an exported program.

    Example:
        >>> ExportConfig(platforms=("cpu",), batch_size=8).grouping
        'single'
    """

    grouping: Literal["single", "batch", "any"] = "single"
    """Which images of a call attend to each other: "single", none; "batch", all; "any", those that
    a mask allows (ONNX and OpenVINO only, as two programs: images to tokens, then descriptors)."""
    batch_size: int | None = None
    """Number of images in a call; None allows any number (a symbolic dimension)."""
    weights_inside: bool = False
    """Whether the program file contains the weights; otherwise they are in a separate file."""
    platforms: tuple[Literal["cpu", "cuda", "rocm", "tpu"], ...] = ("cpu", "cuda")
    """Platforms that a StableHLO program is for; other formats run wherever their engines do."""
    format: Literal["stablehlo", "onnx", "openvino"] = "stablehlo"
    """StableHLO, which JAX runs; ONNX, which most engines read; or the format of OpenVINO."""
    pixels: Literal["bytes", "floats"] | None = None
    """Type of the input images: "bytes", 8-bit pixels, which the program normalises, or "floats",
    already normalised; None takes the type of the model's `PreprocessingConfig.pixels`."""
    for_colmap: bool = False
    """Whether an ONNX program suits COLMAP's unreleased retrieval by global descriptors: it takes
    `images`, normalised floats (batch, 3, height, width), and returns `descriptor`."""

    def __post_init__(self) -> None:
        """Check the values."""
        check_types(self)
        is_stablehlo = self.format == "stablehlo"
        if (is_stablehlo and (self.grouping == "any" or not self.platforms)) or (
            self.format == "openvino" and self.weights_inside
        ):
            raise InputError(
                f"format: found {self.format} with grouping {self.grouping}, {len(self.platforms)} "
                f"platforms and weights inside {self.weights_inside}, expected onnx or openvino "
                "for grouping any, some platform for stablehlo, and no weights inside of openvino"
            )
        if self.batch_size is not None:
            check_count("batch size", self.batch_size)
        given = (self.format, self.grouping, self.pixels or "floats")
        if self.for_colmap and given != ("onnx", "single", "floats"):
            raise InputError(
                f"for colmap: found {', '.join(given)}, expected format onnx, grouping single and "
                "pixels floats"
            )


def check_exportable(params: Crisalad, config: ModelConfig, how: ExportConfig) -> None:
    """Check that a model can be exported as `how` specifies, without tracing it.

    Raises:
        InputError: the parameters do not fit `config`; 2 GiB or more of weights would be inside the
            program; optimal transport raises unless converged (`SinkhornConfig.throw`); inputs are
            floats, but normalised by local contrast; inputs are COLMAP's, but not normalised by
            ImageNet's mean and deviation; or only StableHLO allows `config.compute_dtype`.
    """
    check_params(params, config)
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(params))
    if how.weights_inside and size >= _LARGEST:
        found = f"{size / 2**30:.1f} GiB of parameters"
        raise InputError(f"weights inside: found {found}, expected less than 2 GiB")
    sinkhorn = getattr(config.aggregator, "sinkhorn", None)
    if sinkhorn is not None and sinkhorn.throw:
        raise InputError("SinkhornConfig.throw: found True, expected False in a program")
    chain, dtype = config.preprocessing, config.compute_dtype
    if how.for_colmap and (chain.mean, chain.deviation) != (IMAGENET_MEAN, IMAGENET_DEVIATION):
        found = f"mean {chain.mean} and deviation {chain.deviation}"
        raise InputError(f"for colmap: found {found}, expected ImageNet's, by which COLMAP divides")
    has_floats = how.pixels == "floats" or how.for_colmap
    if has_floats and chain.normalisation != "mean-deviation":
        found = f"floats with normalisation {chain.normalisation}"
        raise InputError(f"pixels: found {found}, expected bytes")
    if how.format != "stablehlo" and dtype != "float32":
        raise InputError(f"compute dtype: found {dtype} with {how.format}, expected float32")


def export_model(params: Crisalad, config: ModelConfig, how: ExportConfig) -> export.Exported:
    """Export a model as a StableHLO function of `(weights, images)`, or of `images` alone.

    `weights`, a dictionary of the arrays by dotted names, is absent if `how.weights_inside` is set.
    `images` are RGB (batch, height, width, 3) of `config.input_size`, uint8 or normalised float32
    (`ExportConfig.pixels`). The function returns descriptors (batch, descriptor). It is the same
    on whatever platform and from whatever code it is exported. Call `check_exportable` first.
    """
    program = _whole_program(Model(params, config), how)
    run, weights, (images,) = program.run, program.weights, program.inputs.values()
    with number_types([config]), lowering_for(PORTABLE), jax_setting(_SOURCES, 0):
        if how.weights_inside:
            whole = jax.jit(lambda images: run(weights, images))
            return export.export(whole, platforms=how.platforms)(images)
        shapes = {n: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for n, leaf in weights.items()}
        return export.export(jax.jit(run), platforms=how.platforms)(shapes, images)


Shapes = dict[str, jax.ShapeDtypeStruct]


class _Program(NamedTuple):
    """A function to export, with its inputs and output."""

    run: Callable[..., Any]
    """A function of the weights and the inputs."""
    weights: dict[str, Any]
    """The arrays by their dotted names."""
    inputs: Shapes
    """Shapes and types of the inputs by name."""
    output: str
    """Name of the output."""


def _whole_program(model: Model, how: ExportConfig) -> _Program:
    """Return the program of images to descriptors."""
    config = model.config

    def run(params: Crisalad, images: Images) -> Float[Array, "image descriptor"]:
        images = jnp.moveaxis(images, 1, 3) if how.for_colmap else images
        mask = self_mask(images.shape[0]) if how.grouping == "single" else None
        return describe(params, images, config, mask=mask)

    images = {"images": _images_shape(config, how)}
    return _program(run, model.params, images, "descriptor" if how.for_colmap else "descriptors")


def _program(
    function: Callable[..., Any], params: Crisalad, inputs: Shapes, output: str
) -> _Program:
    """Turn a function of parameters into one of the weights by name."""
    # A dictionary's leaves come in the order of its keys, not of the fields.
    weights, tree = named_leaves(params), jax.tree.structure(params)

    def run(weights: Mapping[str, Array], *inputs: Array) -> Array:
        leaves = [weights[name] for name in named_leaves(params)]
        return function(jax.tree.unflatten(tree, leaves), *inputs)

    return _Program(run, weights, inputs, output)


def _images_shape(config: ModelConfig, how: ExportConfig) -> jax.ShapeDtypeStruct:
    batch = how.batch_size
    if batch is None:
        (batch,) = export.symbolic_shape("batch")
    dtype = jnp.uint8 if _takes_bytes(config, how) else jnp.float32
    return jax.ShapeDtypeStruct((batch, *_sides(config, how)), dtype)


def _sides(config: ModelConfig, how: ExportConfig) -> tuple[int, ...]:
    """Return the shape of an image, as the program takes it."""
    return (3, *config.input_size) if how.for_colmap else (*config.input_size, 3)


def _takes_bytes(config: ModelConfig, how: ExportConfig) -> bool:
    return not how.for_colmap and (how.pixels or config.preprocessing.pixels) == "bytes"


@takes(out=PATH)
def write_export(
    out: str | os.PathLike[str],
    model: Model,
    how: ExportConfig = ExportConfig(),
    *,
    calibration: np.ndarray | None = None,
) -> dict[str, Any]:
    """Write a model as a program into the new folder `out`, atomically.

    An ONNX or OpenVINO program is run once, to compare its descriptors with those of `describe`.

    Args:
        out: the folder.
        model: parameters and configuration.
        how: format, inputs and platforms of the program.
        calibration: prepared images (image, height, width, 3) to calibrate int8 matrix products
            with, for ONNX and OpenVINO; None keeps float32. An int8 program may differ from
            `describe` by any amount, which the manifest records.

    Returns:
        The content of manifest.json.

    Raises:
        InputError: `check_exportable` rejects the model; `out` is a file or a non-empty folder;
            `calibration` comes with StableHLO, grouping "any", a batch size or weights inside; an
            operation cannot be converted; or, in float32, descriptors differ from `describe`'s.
        ModuleNotFoundError: the extra "onnx" or "openvino" is needed but not installed.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, Model, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> how = ExportConfig(batch_size=2)
        >>> write_export(folder / "export", model, how)["descriptors"]["shape"]
        [2, 576]
    """
    params, config = model
    check_new_folder(out)
    check_exportable(params, config, how)
    is_one_program = how.grouping != "any" and how.batch_size is None and not how.weights_inside
    if calibration is not None and (how.format == "stablehlo" or not is_one_program):
        raise InputError(
            "int8: found format stablehlo, grouping any, weights inside or a batch size, "
            "expected a program of onnx or openvino for any number of images"
        )
    if config.preprocessing.size_rule != "fixed":
        size = " x ".join(map(str, config.input_size))
        warn(
            f"{out}: found images of size rule {config.preprocessing.size_rule}; the program takes "
            f"only {size}"
        )
    with atomic_folder(out) as folder:
        if how.format == "stablehlo":
            own = _write_stablehlo(folder, model, how)
        else:
            own = _write_onnx(folder, model, how, calibration, os.fspath(out))
        digest = model_hash(params, config)
        if calibration is not None:  # its descriptors differ from the model's
            own |= {"quantised_from": digest}
            parts = (digest, *(own[name]["sha256"] for name in ("program", "weights")))
            digest = hashlib.sha256("".join(parts).encode()).hexdigest()
        manifest = {
            "format": FORMAT,
            "program_format": how.format,
            **own,
            "images": _images(config, how),
            "descriptors": {
                "shape": [how.batch_size or "batch", config.descriptor_dim],
                "dtype": "float32",
                "norm": "unit length (L2)" if config.unit_length else "any length",
            },
            "grouping": how.grouping,
            "grouping_means": GROUPINGS[how.grouping],
            "attends_across_images": config.cross_image.attends,
            "jax_version": jax.__version__,
            "model_sha256": digest,
            "model": to_plain(config),
        }
        write_json(folder / MANIFEST, manifest)
    return manifest


def _write_stablehlo(folder: pathlib.Path, model: Model, how: ExportConfig) -> dict[str, Any]:
    """Write the files of `jax.export`, and return their part of the manifest."""
    exported = export_model(*model, how)
    (folder / PROGRAM).write_bytes(exported.serialize(vjp_order=0))
    weights = None
    if not how.weights_inside:
        save_weights(folder / WEIGHTS, model)
        words = {"argument": "a dictionary of all arrays in the file by their names"}
        weights = _file(folder / WEIGHTS) | words
    called = "images" if how.weights_inside else "weights, images"
    return {
        "call": f"jax.export.deserialize(program).call({called})",
        "program": _file(folder / PROGRAM),
        "weights": weights,
        "platforms": list(exported.platforms),
        "calling_convention_version": exported.calling_convention_version,
    }


def _write_onnx(
    folder: pathlib.Path, model: Model, how: ExportConfig, calibration: np.ndarray | None, out: str
) -> dict[str, Any]:
    """Write the files of ONNX or OpenVINO, check them, and return their part of the manifest."""
    from crisalad_jax.checkpoints.onnx_format.program import OPSET, write_onnx

    if how.grouping == "any":
        programs = _halves(model, how)
    else:
        programs = {DESCRIBE: _whole_program(model, how)}
    form, external = engines.FORMATS[how.format], not how.weights_inside
    files: dict[str, Any] = {}
    for name, program in programs.items():
        path = folder / f"{name}.onnx"
        words = f"{', '.join(program.inputs)} to {program.output}; {GROUPINGS[how.grouping]}"
        with number_types([model.config]), lowering_for(STRAIGHT):
            products = write_onnx(path, *program, words=words, external=external)
        if calibration is not None:
            from crisalad_jax.checkpoints.onnx_format.quantise import quantise

            # OpenVINO fails to move per-column scales past a reshape.
            quantise(path, calibration, products, per_channel=how.format == "onnx")
        if how.format == "openvino":
            convert_to_openvino(path, path.with_suffix(".xml"))
            for suffix in engines.FORMATS["onnx"].suffixes:
                path.with_name(name + suffix).unlink()
        file, data = (folder / f"{name}{suffix}" for suffix in form.suffixes)
        files[name] = {"program": _file(file), "weights": _file(data) if external else None}
    difference = _difference(folder, list(files), model, how)
    if calibration is None and not difference <= TOLERANCE:
        raise engines.NotExportableError(
            f"{out}: found descriptors of {form.engine} that differ from those of `describe` by "
            f"{difference:.2g}, expected at most {TOLERANCE:g}: nothing was written"
        )
    first, *others = files
    return {
        "call": form.call.format(file=first + form.suffixes[0]),
        **files[first],
        **{name: files[name] for name in others},
        "side_multiple": model.config.side_multiple,
        "opset": OPSET,
        "products": "float32" if calibration is None else "int8",
        "checked": {"engine": form.engine, "largest_difference": difference},
    }


def _halves(model: Model, how: ExportConfig) -> dict[str, _Program]:
    """Return two programs: images to tokens, and tokens and a mask to descriptors.

    An image's tokens are one row of values: the global token, then the local ones.
    """
    params, config = model
    images, shape = _images_shape(config, how), config.token_shape
    count = images.shape[0]
    width = shape.global_dim + shape.tokens * shape.token_dim

    def extract(backbone: Any, images: Images) -> Float[Array, "image number"]:
        tokens = extract_tokens(backbone, images, config)
        return jnp.concatenate([tokens.global_token, tokens.local.reshape(count, -1)], axis=1)

    def attend(
        model: Any, rows: Float[Array, "image number"], mask: Bool[Array, "image image"]
    ) -> Float[Array, "image descriptor"]:
        local = rows[:, shape.global_dim :].reshape(count, shape.tokens, shape.token_dim)
        tokens = Tokens(rows[:, : shape.global_dim], local)
        return attend_across_images(model, tokens, config, mask=mask)

    rows = jax.ShapeDtypeStruct((count, width), jnp.float32)
    mask = jax.ShapeDtypeStruct((count, count), jnp.bool_)
    return {
        TOKENS: _program(extract, params, {"images": images}, "tokens"),
        ATTEND: _program(attend, params, {"tokens": rows, "mask": mask}, "descriptors"),
    }


def _difference(
    folder: pathlib.Path, names: Sequence[str], model: Model, how: ExportConfig
) -> float:
    """Run a program on noise images, and compare it with `describe`."""
    params, config = model
    count = how.batch_size or _PROBES
    images = np.random.default_rng(0).integers(0, 256, (count, *config.input_size, 3), np.uint8)
    if not _takes_bytes(config, how):
        images = normalised(images, config.preprocessing)
    form = engines.FORMATS[how.format]
    first, *second = (
        load_program(form.engine, folder / f"{name}{form.suffixes[0]}") for name in names
    )
    alone, together = np.eye(count, dtype=bool), np.ones((count, count), bool)
    masks = {"single": [alone], "batch": [together], "any": [alone, together]}[how.grouping]
    found = first(np.ascontiguousarray(np.moveaxis(images, 3, 1)) if how.for_colmap else images)
    worst = 0.0
    for mask in masks:
        expected = np.asarray(describe(params, images, config, mask=jnp.asarray(mask)))
        given = second[0](found, mask) if second else found
        longest = np.linalg.norm(expected, axis=1).max()  # 1, unless a projection changes it
        worst = max(worst, float(np.abs(given - expected).max() / longest))
    return worst


def _images(config: ModelConfig, how: ExportConfig) -> dict[str, Any]:
    """Describe how to prepare images for the program, which takes one size, whatever the rule."""
    chain, size = config.preprocessing, config.input_size
    fixed = dataclasses.replace(chain, size_rule="fixed", round_to_patch=False)
    values = {
        "shape": [how.batch_size or "batch", *_sides(config, how)],
        "resize": f"{fixed.in_words(size)}, aspect ratio not preserved",
    }
    layout = f"RGB, {'by channel, ' if how.for_colmap else ''}rows from the top,"
    if _takes_bytes(config, how):
        return values | {"dtype": "uint8", "layout": f"{layout} not normalised"}
    return values | {
        "dtype": "float32",
        "layout": f"{layout} (pixels / 255 - mean) / deviation",
        "mean": list(chain.mean),
        "deviation": list(chain.deviation),
    }


def _file(path: pathlib.Path) -> dict[str, Any]:
    return {"file": path.name, "bytes": path.stat().st_size, "sha256": sha256_of(path)}
