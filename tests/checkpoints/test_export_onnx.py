"""Programs in ONNX and OpenVINO against the model, and each conversion against JAX."""

import dataclasses
import pathlib
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
import pytest
from jax import export

from crisalad_jax.checkpoints import export as exports
from crisalad_jax.checkpoints.engines import import_openvino, load_program
from crisalad_jax.checkpoints.export import ExportConfig, write_export
from crisalad_jax.checkpoints.onnx_format.program import write_onnx
from crisalad_jax.checkpoints.runtime import open_runtime
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.aggregators.vlad import AnyLocConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.model import Crisalad, Model, init_crisalad
from crisalad_jax.sinkhorn import SinkhornConfig
from crisalad_jax.utils.errors import InputError
from tests.checkpoints.test_export import (
    OTHERS,
    TOLERANCE,
    alone,
    check_any_number,
    check_batch,
    check_manifest,
    pictures,
)
from tests.checkpoints.test_weights import put
from tests.conftest import BATCH, MODEL

pytestmark = pytest.mark.usefixtures("symbolic_shapes")

ALONE = "none"
# Operators that TensorRT's parser has had since version 8.4, of those that programs here may use:
# github.com/onnx/onnx-tensorrt, docs/operators.md.
TENSORRT = """
Abs Add And ArgMax ArgMin Cast Ceil Concat Conv Cos Div Equal Erf Exp Expand Floor Greater
GreaterOrEqual Identity Less LessOrEqual Log MatMul Max MaxPool Min Mul Neg Not Or Pad Pow Range
ReduceMax ReduceMin ReduceProd ReduceSum Reshape Shape Sigmoid Sign Sin Slice Sqrt Squeeze Sub Tanh
Transpose Where Xor
"""


@pytest.fixture(scope="module")
def beside(params: Crisalad, tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """An ONNX export of any number of images, each alone, weights beside it."""
    out = tmp_path_factory.mktemp("exports") / "onnx"
    write_export(out, Model(params, MODEL), ExportConfig(format="onnx"))
    return out


def test_onnx_gives_our_descriptors_for_any_number_of_images(
    beside: pathlib.Path, params: Crisalad
):
    session = onnxruntime.InferenceSession(beside / "describe.onnx")
    check_any_number(lambda images: session.run(None, {"images": images})[0], params)


def test_openvino_gives_our_descriptors_for_any_number_of_images(
    params: Crisalad, tmp_path: pathlib.Path
):
    out = tmp_path / "out"
    manifest = write_export(out, Model(params, MODEL), ExportConfig(format="openvino"))
    assert {p.name for p in out.iterdir()} == {"describe.bin", "describe.xml", "manifest.json"}
    check_any_number(load_program("openvino", out / "describe.xml"), params)
    assert manifest["checked"]["engine"] == "openvino"
    # Weights as halves would be within the tolerance of nothing.
    nodes = import_openvino().Core().read_model(out / "describe.xml").get_ops()
    types = {str(node.get_element_type()) for node in nodes if node.get_output_size()}
    assert not any("'f16'" in each for each in types)


def test_a_processor_without_bfloat16_is_told_of(
    beside: pathlib.Path, params: Crisalad, recwarn: pytest.WarningsRecorder
):
    """OpenVINO takes float32 there without a word."""
    program = load_program("openvino", beside / "describe.onnx", "bfloat16")
    difference = np.abs(program(pictures(2)) - alone(params, pictures(2))).max()
    is_told = any("without bfloat16" in str(each.message) for each in recwarn)
    # 8 bits of a product are off by 4e-3 of it, 24 bits by 6e-8.
    assert (difference < TOLERANCE) == is_told


def test_a_batch_of_one_size_with_the_weights_inside(params: Crisalad, tmp_path: pathlib.Path):
    how = ExportConfig("batch", batch_size=BATCH, weights_inside=True, format="onnx")
    write_export(tmp_path / "out", Model(params, MODEL), how)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"describe.onnx", "manifest.json"}
    check_batch(load_program("onnxruntime", tmp_path / "out" / "describe.onnx"), params)


def test_floats_that_are_normalised_already(params: Crisalad, tmp_path: pathlib.Path):
    how = ExportConfig(format="onnx", pixels="floats")
    manifest = write_export(tmp_path / "out", Model(params, MODEL), how)
    assert manifest["images"]["dtype"] == "float32"
    images = pictures(2)
    mean, deviation = (np.array(manifest["images"][name]) for name in ("mean", "deviation"))
    floats = ((images / 255 - mean) / deviation).astype(np.float32)
    found = load_program("onnxruntime", tmp_path / "out" / "describe.onnx")(floats)
    np.testing.assert_allclose(found, alone(params, images), rtol=0, atol=TOLERANCE)


def test_the_manifest_tells_what_lies_there(beside: pathlib.Path):
    manifest = check_manifest(beside)
    assert manifest["program_format"] == "onnx"
    assert 0 < manifest["checked"]["largest_difference"] < 1e-5


def test_what_tensorrt_needs_of_a_program(beside: pathlib.Path):
    """No TensorRT is here: its parser's operators, known types, and shapes that can be inferred."""
    model = onnx.load(beside / "describe.onnx")
    onnx.checker.check_model(model, full_check=True)
    whole = onnx.shape_inference.infer_shapes(model, strict_mode=True, data_prop=True)
    (opset,) = model.opset_import
    assert (opset.domain, opset.version) == ("", 17)
    nodes = model.graph.node
    assert {node.op_type for node in nodes} <= set(TENSORRT.split())
    assert not any(attribute.HasField("g") for node in nodes for attribute in node.attribute)
    known = {value.name: value.type.tensor_type for value in whole.graph.value_info}
    assert {name for node in nodes[:-1] for name in node.output} == known.keys()
    allowed = {onnx.TensorProto.FLOAT, onnx.TensorProto.INT32, onnx.TensorProto.INT64}
    assert {each.elem_type for each in known.values()} <= allowed | {onnx.TensorProto.BOOL}


BARE = {
    "NetVLAD": {"aggregator": "netvlad"},
    "class token": {"aggregator": "class-token"},
    "AnyLoc": {"aggregator": AnyLocConfig(layer=-1)},
    "ResNet": {
        "image_size": (64, 96),
        "backbone": ResNetConfig(layers=18),
        "aggregator": ConvApConfig(channels=16),
    },
}
MODELS = OTHERS | {
    "SuperVLAD": dataclasses.replace(MODEL, aggregator="supervlad"),
    "tiny": PRESETS["tiny"],
    **{name: dataclasses.replace(MODEL, cross_image=ALONE, **each) for name, each in BARE.items()},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("format", ["onnx", "openvino"])
def test_other_models(name: str, format: Any, tmp_path: pathlib.Path):
    config = MODELS[name]
    params = init_crisalad(jax.random.key(0), config)
    manifest = write_export(tmp_path / "out", Model(params, config), ExportConfig(format=format))
    assert manifest["checked"]["largest_difference"] < TOLERANCE


ROWS, COLUMNS = 3, 4
FUNCTIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "clamp": lambda x: jnp.clip(x, 0.2, 0.7),
    "logarithms": lambda x: jnp.log1p(x) + jnp.expm1(x) + jnp.exp2(x),
    "powers": lambda x: x**2 + x**3 + jax.lax.rsqrt(x + 1) + x**0.3,
    "logic": lambda x: ((x > 0.3) & ~(x > 0.6) | (x != 0.5)).astype(jnp.float32),
    "halves": lambda x: (
        jnp.round(jnp.floor(16 * x) / 2) + 9 * jax.lax.round(4 - jnp.floor(16 * x) / 2)
    ),
    "finite": lambda x: jnp.isfinite(x / jnp.where(x > 0.5, 0, 1)).astype(jnp.float32),
    "sums": lambda x: x.sum(1) + x.max(1) + x.min(1) + x.prod(1),
    "any and all": lambda x: ((x > 0.5).any(1) | (x > 0.1).all(1)).astype(jnp.float32),
    "argmax": lambda x: jax.nn.one_hot(x.argmax(2), COLUMNS),
    "slices": lambda x: jax.lax.slice_in_dim(x, 0, 3, 2, axis=1)[..., 1:3] + x[:, :1, :2],
    "the last": lambda x: x[:, -1],
    "pad": lambda x: jnp.pad(x, ((0, 0), (1, 2), (0, 1)), constant_values=3),
    "split": lambda x: jnp.concatenate(jnp.split(x, [1, 3], axis=2)[::-1], axis=2),
    "stack": lambda x: jnp.stack([x, 2 * x, jnp.ones_like(x)], axis=2),
    "nothing": lambda x: jnp.concatenate([x[:, :0], x], axis=1),
    "broadcast": lambda x: jnp.concatenate([jnp.broadcast_to(x[:, :1], x.shape), x], axis=1),
    "reshape": lambda x: jnp.broadcast_to(x[:, None], (x.shape[0], 2, ROWS, COLUMNS)).reshape(
        x.shape[0], -1
    ),
    "numbers": lambda x: x + jnp.arange(COLUMNS) + jnp.arange(x.shape[0])[:, None, None],
    "outer": lambda x: jnp.einsum("bij,cij->bc", x, x) * jnp.eye(x.shape[0]),
    "products": lambda x: jnp.einsum("bij,bkj->bik", x, x) @ jnp.ones((ROWS, 2)),
    "two sums": lambda x: jnp.einsum("bij,ijk->bk", x, jnp.ones((ROWS, COLUMNS, 2))),
    "all rows": lambda x: jnp.einsum("bij,jkl->bikl", x, jnp.ones((COLUMNS, 2, 3))),
    "matrix first": lambda x: jnp.einsum("kj,bij->kbi", jnp.ones((2, COLUMNS)), x),
    "row alone": lambda x: jnp.einsum("bij,bj->bi", x, x[:, 0]),
    "loop": lambda x: jax.lax.scan(
        lambda c, r: (c + r, c * r), x[:, 0], jnp.moveaxis(x, 1, 0), reverse=True
    )[1],
    "loop over weights": lambda x: jax.lax.scan(
        lambda c, w: (jnp.tanh(c * w), None), x, jnp.arange(3.0)
    )[0],
    "a branch that is known": lambda x: jax.lax.cond(True, jnp.sin, jnp.cos, x),
    "convolution": lambda x: jax.lax.conv_general_dilated(
        x[..., None],
        jnp.arange(12.0).reshape(2, 3, 1, 2),
        (1, 2),
        [(1, 0), (0, 1)],
        rhs_dilation=(1, 1),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    ),
    "largest of windows": lambda x: jax.lax.reduce_window(
        x[..., None], -jnp.inf, jax.lax.max, (1, 2, 3, 1), (1, 1, 2, 1), "SAME"
    ),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_conversion_computes_what_jax_does(name: str, tmp_path: pathlib.Path):
    """By both engines, for two numbers of images."""

    def run(weights: dict[str, Any], images: jax.Array) -> jax.Array:
        return FUNCTIONS[name](images)

    (batch,) = export.symbolic_shape("batch")
    shape = jax.ShapeDtypeStruct((batch, ROWS, COLUMNS), jnp.float32)
    path = tmp_path / "program.onnx"
    write_onnx(path, run, {}, {"x": shape}, "y", words="a test", external=False)
    onnx.checker.check_model(onnx.load(path), full_check=True)
    programs = [load_program("onnxruntime", path), load_program("openvino", path)]
    for count in (1, 5):
        images = np.random.default_rng(count).random((count, ROWS, COLUMNS), np.float32)
        expected = run({}, jnp.asarray(images))
        for program in programs:
            # A few operations on numbers up to 100, of which float32 keeps seven digits.
            np.testing.assert_allclose(program(images), expected, rtol=1e-5, atol=1e-6)


LOOP = SinkhornConfig(tolerance=1e-3, gradient="stop")
THROWING = dataclasses.replace(LOOP, throw=True)


def refused(config: ModelConfig, how: ExportConfig, out: pathlib.Path) -> str:
    """What is said; nothing is left behind."""
    params = init_crisalad(jax.random.key(0), config)
    with pytest.raises(InputError) as caught:
        write_export(out, Model(params, config), how)
    assert list(out.parent.iterdir()) == []
    return str(caught.value)


@pytest.mark.parametrize(
    ("field", "value", "how", "words"),
    [
        ("aggregator.sinkhorn", LOOP, {"format": "onnx"}, "onnx or openvino: found the operation "),
        ("aggregator.sinkhorn", THROWING, {}, "SinkhornConfig.throw: found True"),
        ("compute_dtype", "bfloat16", {"format": "openvino"}, "found bfloat16 with openvino, exp"),
        (
            *("preprocessing.normalisation", "local-contrast", {"pixels": "floats"}),
            "found floats with normalisation local-contrast",
        ),
    ],
)
def test_what_a_program_cannot_do(
    field: str, value: Any, how: dict[str, Any], words: str, tmp_path: pathlib.Path
):
    config = put(MODEL, field, value)
    assert words in refused(config, ExportConfig(**how), tmp_path / "out")


def test_a_program_that_differs_is_not_written(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(exports, "TOLERANCE", 1e-12)
    said = refused(MODEL, ExportConfig(format="onnx"), tmp_path / "out")
    assert said.startswith(f"{tmp_path}/out: found descriptors of onnxruntime that differ")


@pytest.mark.parametrize(
    ("format", "module"),
    [("onnx", "onnx"), ("onnx", "onnxruntime"), ("openvino", "openvino")],
)
def test_what_is_not_installed_is_named(params, format, module, tmp_path, monkeypatch):
    """The command line says which extra has it."""
    for name in list(sys.modules):
        if name.startswith("crisalad_jax.checkpoints.onnx_format"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ModuleNotFoundError) as caught:
        write_export(tmp_path / "out", Model(params, MODEL), ExportConfig(format=format))
    assert caught.value.name == module
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_an_engine_cannot_read(tmp_path: pathlib.Path):
    (tmp_path / "broken.onnx").write_bytes(b"no program")
    for engine in ("onnxruntime", "openvino"):
        with pytest.raises(InputError, match=rf"broken\.onnx: {engine} cannot load it: "):
            load_program(engine, tmp_path / "broken.onnx")


@pytest.mark.parametrize("format", ["onnx", "openvino"])
def test_products_of_eight_bits(format: Any, params: Crisalad, tmp_path: pathlib.Path):
    """Quantisation is worth its name only if descriptors move, and stay near all the same."""
    images = pictures(8)
    how = ExportConfig(format=format)
    manifest = write_export(tmp_path / "out", Model(params, MODEL), how, calibration=images)
    assert manifest["products"] == "int8"
    names = {path.suffix for path in (tmp_path / "out").iterdir()}
    engine, suffixes = {
        "onnx": ("onnxruntime", {".onnx", ".data"}),
        "openvino": ("openvino", {".xml", ".bin"}),
    }[format]
    assert names == {".json"} | suffixes
    program = load_program(engine, tmp_path / "out" / manifest["program"]["file"])
    cosines = np.sum(program(images) * alone(params, images), axis=1)
    # Steps of 1/127 of the largest number, in two blocks and three networks: a few percent.
    assert cosines.min() > 0.95
    assert cosines.max() < 1 - 1e-5


def test_eight_bits_of_a_program_that_takes_one_number_of_images(
    params: Crisalad, tmp_path: pathlib.Path
):
    how = ExportConfig(format="onnx", batch_size=2)
    with pytest.raises(InputError, match=r"^int8: found format stablehlo, grouping any"):
        write_export(tmp_path / "out", Model(params, MODEL), how, calibration=pictures(2))


# COLMAP


def test_a_program_has_the_inputs_and_outputs_that_colmap_reads(params, tmp_path):
    """As in colmap/colmap#4544: names, shapes and types, of images that are normalised by it."""
    how = ExportConfig(format="onnx", for_colmap=True)
    manifest = write_export(tmp_path / "out", Model(params, MODEL), how)
    assert manifest["images"]["shape"] == ["batch", 3, 42, 56]
    session = onnxruntime.InferenceSession(tmp_path / "out" / "describe.onnx")
    ((image,), (descriptor,)) = session.get_inputs(), session.get_outputs()
    assert (image.name, image.type, image.shape[1:]) == ("images", "tensor(float)", [3, 42, 56])
    dim = MODEL.descriptor_dim
    assert (descriptor.name, descriptor.shape[1:]) == ("descriptor", [dim])
    assert not isinstance(image.shape[0], int)
    assert not isinstance(descriptor.shape[0], int)
    given = pictures(3)
    mean, deviation = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    prepared = ((given / 255 - mean) / deviation).transpose(0, 3, 1, 2).astype(np.float32)
    (found,) = session.run(None, {"images": prepared})
    np.testing.assert_allclose(found, alone(params, given), atol=TOLERANCE, rtol=0)
    with pytest.raises(InputError, match="found a program for images of 3 x 42, float32"):
        open_runtime(tmp_path / "out", "onnxruntime")


@pytest.mark.parametrize(
    "changes", [{"format": "openvino"}, {"grouping": "batch"}, {"pixels": "bytes"}]
)
def test_colmap_reads_no_other_programs(changes):
    with pytest.raises(InputError, match=r"for colmap: found .* expected format onnx, grouping"):
        ExportConfig(**{"format": "onnx", "for_colmap": True} | changes)


def test_colmap_normalises_as_imagenet(params, tmp_path):
    chain = dataclasses.replace(MODEL.preprocessing, mean=(0.5, 0.5, 0.5))
    model = Model(params, dataclasses.replace(MODEL, preprocessing=chain))
    with pytest.raises(InputError, match=r"for colmap: found mean .* expected ImageNet's"):
        write_export(tmp_path / "out", model, ExportConfig(format="onnx", for_colmap=True))
