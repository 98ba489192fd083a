"""`crisalad export`."""

import pathlib
from typing import TYPE_CHECKING, Annotated, Any, Literal

from crisalad_jax.cli.common import echo, load_model, pick
from crisalad_jax.cli.flags import NEW_FOLDER, ComputeFlags, JsonFlag, PluginFlag
from crisalad_jax.config.checks import require

if TYPE_CHECKING:
    import numpy as np

    from crisalad_jax.nn.config import ModelConfig


class Export(ComputeFlags, PluginFlag, JsonFlag):
    """Write a model as a program that runs without this package: StableHLO, ONNX or OpenVINO."""

    weights: pathlib.Path
    """A weight file of this package, or a published model's name (`crisalad models`)."""
    out: Annotated[pathlib.Path, NEW_FOLDER]
    """New folder for the program, its manifest.json and its weights."""
    format: Literal["stablehlo", "onnx", "openvino"] = "stablehlo"
    """stablehlo, for JAX; onnx, for onnxruntime, TensorRT and others; or openvino. The last two are
    run once, and compared with this package (docs/export.md)."""
    batch_size: int | Literal["symbolic"] = "symbolic"
    """Number of images per call, or symbolic for any number."""
    grouping: Literal["single", "batch", "any"] = "single"
    """single describes every image independently, batch lets a call's images attend to each other;
    any writes two programs of onnx or openvino, and a mask says which images attend to which."""
    weights_inside: bool = False
    """Store the weights as constants in the program, not in a file next to it."""
    pixels: Literal["bytes", "floats"] | None = None
    """Type of the input images: bytes, which the program normalises, or floats, already normalised;
    by default the type that the model's resize returns."""
    for_colmap: bool = False
    """For onnx: use the inputs and outputs of COLMAP's unreleased retrieval by global descriptors
    (docs/export.md)."""
    int8: pathlib.Path | None = None
    """For onnx or openvino: quantise products and convolutions, calibrated on these photographs: a
    few dozen typical ones, in any image source (of a video, one a second). Costs recall
    (docs/export.md)."""
    platforms: str | None = None
    """For stablehlo: platforms, comma-separated: cpu, cuda, rocm, tpu; by default cpu,cuda."""


def run(arguments: Export) -> dict[str, Any]:
    """Export the model, and print what was written; return the result for --json."""
    from crisalad_jax.checkpoints.export import ExportConfig, write_export

    require(
        arguments.platforms is None or arguments.format == "stablehlo",
        f"--platforms: found with --format {arguments.format}, expected --format stablehlo",
    )
    how = ExportConfig(
        batch_size=None if arguments.batch_size == "symbolic" else arguments.batch_size,
        platforms=tuple(dict.fromkeys((arguments.platforms or "cpu,cuda").split(","))),  # pyright: ignore
        **pick(arguments, "grouping", "weights_inside", "format", "pixels", "for_colmap"),
    )
    model = load_model(arguments.weights, arguments)
    calibration = arguments.int8 and read_calibration(arguments.int8, model.config)
    manifest = write_export(arguments.out, model, how, calibration=calibration)
    shapes = (
        f"{manifest[name]['dtype']} ({', '.join(map(str, manifest[name]['shape']))})"
        for name in ("images", "descriptors")
    )
    if how.format == "stablehlo":
        last = f"for {', '.join(manifest['platforms'])}"
    else:
        checked = manifest["checked"]
        last = (
            f"{how.format}, {manifest['products']}; {checked['engine']} differs by at most "
            f"{checked['largest_difference']:.1g} from this package"
        )
    inside = "inside" if how.weights_inside else "in a separate file"
    echo(
        f"{arguments.out}: images {' -> descriptors '.join(shapes)}; "
        f"{manifest['grouping_means']}; weights {inside}; {last}"
    )
    return {"out": str(arguments.out), "manifest": manifest}


_MOST = 256
"""Largest number of photographs to quantise with: more make no difference."""


def read_calibration(images: pathlib.Path, config: "ModelConfig") -> "np.ndarray":
    """Read up to 256 photographs, evenly spaced in `images`; return them prepared for the model."""
    import numpy as np

    from crisalad_jax.data.images import read_pixels
    from crisalad_jax.data.sources import open_source
    from crisalad_jax.retrieval.describe import prepare_image

    rule = config.preprocessing.size_rule
    require(rule == "fixed", f"int8: found images of size rule {rule}, expected --resize fixed")
    paths = open_source(images, fps=1.0).paths
    chosen = paths[:: -(-len(paths) // _MOST)]
    return np.stack([prepare_image(read_pixels(path), config, str(path)) for path in chosen])
