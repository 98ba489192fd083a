"""Exported programs against the model, and run where the package cannot be imported."""

import dataclasses
import functools
import hashlib
import json
import pathlib
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import cv2
import jax
import numpy as np
import pytest
import safetensors.numpy
from jax import export

from crisalad_jax.checkpoints.export import (
    ExportConfig,
    check_exportable,
    export_model,
    write_export,
)
from crisalad_jax.checkpoints.weights import model_hash
from crisalad_jax.config.io import to_plain
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.data.images import list_images, read_image
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.aggregators.gem import CosPlaceConfig
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig
from crisalad_jax.nn.aggregators.queries import BoqConfig
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.model import Crisalad, Model, describe, init_crisalad, self_mask
from crisalad_jax.sinkhorn import SinkhornConfig
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import write_json
from crisalad_jax.utils.pytree import named_leaves
from tests.conftest import BATCH, MODEL, write_picture

pytestmark = pytest.mark.usefixtures("symbolic_shapes")

NEWTON = dataclasses.replace(
    MODEL.aggregator,
    sinkhorn=SinkhornConfig(step="newton", tolerance=1e-4, iterations=20, gradient="stop"),
)
OTHERS = {
    name: dataclasses.replace(MODEL, aggregator=aggregator)
    for name, aggregator in {
        "pyramid": "gem-pyramid",
        "GeM": "gem",
        "Conv-AP": ConvApConfig(channels=16),
        "CosPlace": CosPlaceConfig(dim=16),
        "MixVPR": MixVprConfig(16, 3, 2),
        "BoQ": BoqConfig(16, 3, 2, 5),
    }.items()
}
"""Models of other aggregators."""
PLAIN = OTHERS | {
    "bfloat16": dataclasses.replace(MODEL, compute_dtype="bfloat16"),
    "newton": dataclasses.replace(MODEL, aggregator=NEWTON),
}
SCRIPT = pathlib.Path(__file__).parents[2] / "scripts" / "run_exported.py"
# The same operations, which another order of the compiler's rounds otherwise: numbers of a unit
# descriptor are below 1, and float32 keeps 1e-7 of them. test_cli has the same.
TOLERANCE = 2e-6


def pictures(count: int) -> np.ndarray:
    generator = np.random.default_rng(7)
    return generator.integers(0, 256, (count, *MODEL.image_size, 3), np.uint8)


def run_script(*arguments: object, cwd: pathlib.Path) -> subprocess.CompletedProcess[str]:
    """Run the script by an interpreter that cannot import this package."""
    program = (
        "import runpy, sys\n"
        "sys.modules['crisalad_jax'] = None\n"
        "sys.argv = sys.argv[1:]\n"
        "runpy.run_path(sys.argv[0], run_name='__main__')\n"
    )
    command = [sys.executable, "-I", "-c", program, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True)


def alone(params: Crisalad, images: np.ndarray, config: ModelConfig = MODEL) -> np.ndarray:
    return np.asarray(describe(params, images, config, mask=self_mask(len(images))))


def check_any_number(program: Callable[[np.ndarray], Any], params: Crisalad) -> None:
    """The program gives our descriptors for any number of images."""
    for count in (1, BATCH):
        found = program(pictures(count))
        np.testing.assert_allclose(found, alone(params, pictures(count)), rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-6)


def check_batch(program: Callable[[np.ndarray], Any], params: Crisalad) -> None:
    """The program's images look at each other: another grouping would not pass."""
    images = pictures(BATCH)
    found = program(images)
    np.testing.assert_allclose(found, describe(params, images, MODEL), rtol=0, atol=TOLERANCE)
    assert np.abs(alone(params, images) - found).max() > 1e-3


def check_manifest(folder: pathlib.Path) -> dict[str, Any]:
    """The manifest tells what lies there."""
    manifest = json.loads((folder / "manifest.json").read_text())
    for part in ("program", "weights"):
        data = (folder / manifest[part]["file"]).read_bytes()
        assert manifest[part]["bytes"] == len(data)
        assert manifest[part]["sha256"] == hashlib.sha256(data).hexdigest()
    assert manifest["images"]["shape"] == ["batch", 42, 56, 3]
    assert manifest["descriptors"]["shape"] == ["batch", MODEL.descriptor_dim]
    return manifest


@pytest.fixture(scope="module")
def beside(params: Crisalad, tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """An export of any number of images, each alone, weights beside it."""
    out = tmp_path_factory.mktemp("exports") / "beside"
    write_export(out, Model(params, MODEL))
    return out


def test_the_program_gives_our_descriptors_for_any_number_of_images(
    beside: pathlib.Path, params: Crisalad
):
    program = export.deserialize(bytearray((beside / "describe.jax_export").read_bytes()))
    weights = safetensors.numpy.load_file(beside / "weights.safetensors")
    check_any_number(functools.partial(program.call, weights), params)
    assert program.platforms == ("cpu", "cuda")


def test_a_batch_of_one_size_with_the_weights_inside(params: Crisalad, tmp_path: pathlib.Path):
    out = tmp_path / "inside"
    how = ExportConfig("batch", batch_size=BATCH, weights_inside=True, platforms=("cpu",))
    manifest = write_export(out, Model(params, MODEL), how)
    program = export.deserialize(bytearray((out / "describe.jax_export").read_bytes()))
    check_batch(program.call, params)
    assert manifest["weights"] is None
    assert manifest["images"]["shape"] == [BATCH, *MODEL.image_size, 3]
    assert {path.name for path in out.iterdir()} == {"describe.jax_export", "manifest.json"}
    with pytest.raises(ValueError, match="shape"):
        program.call(pictures(1))


def test_the_manifest_tells_what_lies_there(beside: pathlib.Path, params: Crisalad):
    manifest = check_manifest(beside)
    assert manifest["images"]["dtype"] == "uint8"
    assert manifest["descriptors"]["dtype"] == "float32"
    assert manifest["grouping"] == "single"
    assert manifest["platforms"] == ["cpu", "cuda"]
    assert manifest["jax_version"] == jax.__version__
    assert manifest["model_sha256"] == model_hash(params, MODEL)


@pytest.mark.slow
def test_a_script_without_this_package(
    beside: pathlib.Path, params: Crisalad, tmp_path: pathlib.Path
):
    """Pictures of the model's size, read without loss: the same pixels, so the same numbers."""
    folder = tmp_path / "pictures"
    (folder / "deep").mkdir(parents=True)
    images = pictures(BATCH + 1)
    names = ["a.png", "b.PNG", "c.png", "deep/a.png", "deep/b.png"]
    for name, image in zip(names, images, strict=True):
        assert cv2.imwrite(str(folder / name), image[..., ::-1])
    flags = ("--images", folder, "--out", "found.npy", "--batch-size", BATCH)
    done = run_script(beside, *flags, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "found.names.txt").read_text().splitlines() == names
    found = np.load(tmp_path / "found.npy")
    np.testing.assert_allclose(found, alone(params, images), rtol=0, atol=TOLERANCE)


def told(how: PreprocessingConfig, shape: tuple[int | str, ...]) -> dict[str, Any]:
    """What a manifest says of images that are prepared like this."""
    dtype = "uint8" if how.pixels == "bytes" else "float32"
    images = {"shape": shape, "dtype": dtype, "resize": how.in_words(MODEL.image_size)}
    images |= {"mean": how.mean, "deviation": how.deviation}
    model = {"preprocessing": to_plain(how), "image_size": list(MODEL.image_size)}
    return {"images": images, "grouping": "single", "model": model}


@pytest.mark.parametrize("filter", ["bilinear", "bicubic"])
@pytest.mark.parametrize("pixels", ["bytes", "floats"])
def test_a_script_prepares_images_as_we_do(
    scripts: Any, tmp_path: pathlib.Path, filter: Any, pixels: Any
):
    for name, seed in (("a.jpg", 1), ("b.png", 2)):
        write_picture(tmp_path / name, seed, noise=30.0)
    how = PreprocessingConfig(filter=filter, pixels=pixels)
    manifest = told(how, ("batch", *MODEL.image_size, 3))
    for path in list_images(tmp_path):
        found = scripts("run_exported").read_image(path, manifest)
        expected = Preparation(MODEL.image_size, how).prepare(read_image(path))
        assert found.dtype == expected.dtype
        # A level where Pillow rounds the rows before the columns, one more where decoders differ.
        levels = 2 if pixels == "bytes" else 2 / 255 / min(how.deviation)
        assert np.abs(found.astype(float) - expected).max() <= levels
        other = dataclasses.replace(how, filter={"bilinear": "bicubic"}.get(filter, "bilinear"))
        far = Preparation(MODEL.image_size, other).prepare(read_image(path))
        assert np.abs(found.astype(float) - far).max() > 2 * levels


def test_a_script_refuses_what_it_cannot_do(scripts: Any, tmp_path: pathlib.Path):
    script = scripts("run_exported")
    how = PreprocessingConfig(filter="area")
    write_picture(tmp_path / "a.png", 1)
    with pytest.raises(SystemExit, match=r"found images resized .* area.*, which Pillow cannot do"):
        script.read_image(tmp_path / "a.png", told(how, ("batch", *MODEL.image_size, 3)))
    write_json(tmp_path / "manifest.json", {"program_format": "onnx", "call": "onnxruntime"})
    with pytest.raises(SystemExit, match="found a program of onnx, expected stablehlo"):
        script.read_manifest(tmp_path)


def test_a_script_fills_the_last_batch_or_refuses(
    params: Crisalad, tmp_path: pathlib.Path, scripts: Any
):
    script = scripts("run_exported")
    for name in "abc":
        write_picture(tmp_path / f"{name}.png", ord(name))
    paths = list_images(tmp_path)
    manifest = told(PreprocessingConfig(), (2, 42, 56, 3))
    (first, two), (last, one) = script.batches(paths, manifest, 16)
    assert (first.shape, two, last.shape, one) == ((2, 42, 56, 3), 2, (2, 42, 56, 3), 1)
    np.testing.assert_array_equal(last[0], script.read_image(paths[2], manifest))
    with pytest.raises(SystemExit, match="found 3 images, expected a multiple of 2"):
        list(script.batches(paths, manifest | {"grouping": "batch"}, 16))


@pytest.mark.slow
@pytest.mark.parametrize("name", PLAIN)
def test_other_models_for_all_platforms(name: str):
    """Newton's steps solve linear systems, by another library on every platform."""
    config = PLAIN[name]
    params = init_crisalad(jax.random.key(0), config)
    exported = export_model(params, config, ExportConfig(platforms=("cpu", "cuda", "rocm", "tpu")))
    program = export.deserialize(exported.serialize(vjp_order=0))
    images = pictures(BATCH)
    found = program.call(named_leaves(params), images)
    # bfloat16 keeps 8 bits, and libraries of products round at different places.
    tolerance = 0.02 if config.compute_dtype == "bfloat16" else TOLERANCE
    np.testing.assert_allclose(found, alone(params, images, config), rtol=0, atol=tolerance)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"platforms": ()}, "format: found stablehlo with grouping single, 0 platforms"),
        ({"grouping": "any"}, "format: found stablehlo with grouping any"),
        ({"format": "openvino", "weights_inside": True}, "2 platforms and weights inside True"),
    ],
)
def test_what_cannot_be_asked_for(fields: dict[str, Any], words: str):
    with pytest.raises(InputError) as caught:
        ExportConfig(**fields)
    assert words in str(caught.value)


def test_weights_that_are_too_many_to_be_inside():
    config = PRESETS["g14"]
    shapes = jax.eval_shape(functools.partial(init_crisalad, config=config), jax.random.key(0))
    check_exportable(shapes, config, ExportConfig())
    with pytest.raises(InputError, match=r"^weights inside: found 4\.\d GiB of parameters, exp"):
        check_exportable(shapes, config, ExportConfig(weights_inside=True))
