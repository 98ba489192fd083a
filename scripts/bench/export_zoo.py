"""Export every kind of published model in every format, and measure what the formats change.

    python scripts/bench/export_zoo.py [--models salad cricavpr]

Weights are random, with the shapes of the files in parity/.
"""

import gc
import pathlib
import sys
import tempfile

import jax
import numpy as np
import safetensors.numpy
from tables import Study, Table, flags, leave, read

from crisalad_jax.checkpoints.export import FORMATS, ExportConfig, write_export
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.model import Crisalad, Model, describe, init_crisalad, self_mask
from crisalad_jax.utils.errors import InputError

ROOT = pathlib.Path(__file__).parents[2]
MODELS = (
    *("tiny", "b14", "salad", "salad-cm", "megaloc", "cricavpr", "boq-dinov2", "boq-resnet50"),
    *("mixvpr-4096", "conv-ap-4096", "cosplace-vgg16-512", "cosplace-resnet18-512"),
    *("eigenplaces-resnet50-2048", "netvlad-nanne", "netvlad-hloc", "patch-netvlad-mapillary-4096"),
    *("selavpr-msls", "transvpr-msls", "supervlad", "supervlad-crossimage", "supervlad-1-cluster"),
    *("selavprpp-vitb14", "selavprpp-vitb14-rerank", "sage-vitb14", "sfrs", "pairvpr-vitb14"),
    *("ap-gem-resnet101", "tetra-boq", "tetra-salad"),
    *("edtformer", "image", "dino-mix", "vlad-buff-4096", "vlad-buff-8192", "fol-base"),
    *("salad-indoor-gb1-10-25", "dinov2-vits14", "dinov2-vitb14-reg4", "dinov3-vits16"),
    *("dinov3-vits16plus", "anyloc-indoor"),
)
"""One model of each kind; its other sizes use the same operations."""
IMAGES = 3


def config_of(name: str) -> ModelConfig:
    """Return the configuration of a preset, or of a published model by the shapes in its file."""
    if name in PRESETS:
        return PRESETS[name]
    sys.path.insert(0, str(ROOT))
    from tests.checkpoints.test_published import inferred

    return inferred(name)[1]


def difference(
    folder: pathlib.Path, params: Crisalad, config: ModelConfig, how: ExportConfig
) -> float:
    """Measure the largest difference of a format's descriptors; raise InputError if unsupported."""
    manifest = write_export(folder, Model(params, config), how)
    if how.format != "stablehlo":
        return manifest["checked"]["largest_difference"]
    program = jax.export.deserialize(bytearray((folder / "describe.jax_export").read_bytes()))
    weights = safetensors.numpy.load_file(folder / "weights.safetensors")
    images = np.random.default_rng(0).integers(0, 256, (IMAGES, *config.input_size, 3), np.uint8)
    if manifest["images"]["dtype"] == "float32":
        mean, deviation = (
            np.array(each, np.float32)
            for each in (config.preprocessing.mean, config.preprocessing.deviation)
        )
        images = (images / np.float32(255) - mean) / deviation
    mask = self_mask(IMAGES) if how.grouping == "single" else None
    expected = np.asarray(describe(params, images, config, mask=mask))
    longest = np.linalg.norm(expected, axis=1).max()
    return float(np.abs(program.call(weights, images) - expected).max() / longest)


def row(name: str) -> list[str]:
    """Make a table row: the model, its size, and each format under each grouping."""
    config = config_of(name)
    params = init_crisalad(jax.random.key(0), config)
    cells = [name, " x ".join(map(str, config.input_size)), str(config.descriptor_dim)]
    for grouping in ("single", "batch"):
        for format in FORMATS:
            if grouping == "batch" and params.cross_image is None:
                cells.append("")
                continue
            how = ExportConfig(grouping, platforms=("cpu",), format=format)  # type: ignore
            with tempfile.TemporaryDirectory() as folder:
                try:
                    found = difference(pathlib.Path(folder) / "export", params, config, how)
                    cells.append(f"{found:.0e}")
                except InputError as error:
                    print(f"{name}, {format}: {error}", file=sys.stderr)
                    cells.append("no")
    return cells


def main() -> None:
    parser = flags((__doc__ or "").splitlines()[0], "docs/export")
    parser.add_argument("--models", nargs="+", default=MODELS)
    given = read(parser, "zoo")
    rows = []
    for name in given.models:
        rows.append(tuple(row(name)))
        print(*rows[-1], sep="  ", file=sys.stderr, flush=True)
        gc.collect()
    formats = [f"{each}, {grouping}" for grouping in ("single", "batch") for each in FORMATS]
    header = "model", "images", "dimensions", *formats
    caption = "Largest difference in any dimension of a few descriptors from those of `describe`."
    leave("zoo", Study(Table(header, rows, caption, 2), rows), given)


if __name__ == "__main__":
    main()
