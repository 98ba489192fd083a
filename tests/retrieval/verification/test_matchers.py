"""SIFT against a known shift, and ONNX programs of the contract and of others."""

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from crisalad_jax.retrieval.verification.matchers import OnnxMatcher, SiftMatcher, open_matcher
from crisalad_jax.retrieval.verification.verify import Verifier, Verify
from crisalad_jax.synthetic.picture import render
from crisalad_jax.synthetic.view import View
from crisalad_jax.utils.errors import InputError


@pytest.mark.parametrize("factor", [1, 4])
def test_sift_finds_a_shift(factor):
    """Also of thumbnails, which are enlarged: of 160 pixels."""
    street = render(1, View(), (480 // factor, 640 // factor))
    shift = np.array([40, 24]) // factor
    query, moved = street[shift[1] :, shift[0] :], street[: -shift[1], : -shift[0]]
    matcher = SiftMatcher()
    ours, theirs = matcher.match(matcher.prepare(query), matcher.prepare(moved))
    assert len(ours) > 20
    found = theirs - ours
    # SIFT places points to some tenths of a pixel; a few matches are of repeated windows.
    assert np.abs(np.median(found, axis=0) - shift).max() < 0.1
    assert (np.abs(found - shift).max(axis=1) < 1).mean() > 0.8


def test_a_blank_image_has_no_inliers(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), render(1, View(), (120, 160)))
    blank = np.full((120, 160), 127, np.uint8)
    cv2.imwrite(str(tmp_path / "b.png"), blank)
    names = [(str(tmp_path), name) for name in ("a.png", "b.png")]
    for check in Verifier(Verify()).check(blank, names):
        assert (check.inliers, check.matches, check.confidence) == (0, 0, 0)


KEYPOINTS = np.array([[[0, 0], [10, 20], [30, 50]], [[5, 5], [7, 9], [63, 31]]], np.float32)
MATCHES = np.array([[0, 1, 2], [0, 2, 0]], np.int64)


def write_matcher(file, shape=(2, 3, 32, 64), kind=TensorProto.FLOAT, outputs=None, **constants):
    """Write a program that always answers the same, and needs the contract's input."""
    constants = {"keypoints": KEYPOINTS, "matches": MATCHES} | constants
    constants |= {"mscores": np.ones(2, np.float32)}
    nodes = [
        helper.make_node("Constant", [], [name], value=numpy_helper.from_array(value, name))
        for name, value in constants.items()
    ]
    types = {np.dtype("float32"): TensorProto.FLOAT, np.dtype("int64"): TensorProto.INT64}
    values = [
        helper.make_tensor_value_info(name, types[value.dtype], value.shape)
        for name, value in constants.items()
        if outputs is None or name in outputs
    ]
    images = helper.make_tensor_value_info("images", kind, shape)
    graph = helper.make_graph(nodes, "matcher", [images], values)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10)
    onnx.save(model, file)
    return file


@pytest.mark.parametrize("channels", [1, 3])
def test_an_onnx_matcher_of_a_size(tmp_path, channels):
    """Its pixels are scaled to those of each image: by 2 and 3 here."""
    matcher = open_matcher(write_matcher(tmp_path / "m.onnx", (2, channels, 32, 64)))
    first = np.zeros((64, 128, 3), np.uint8)
    first[:32] = 255
    prepared = matcher.prepare(first), matcher.prepare(np.zeros((96, 192, 3), np.uint8))
    assert prepared[0][0].shape == (channels, 32, 64)
    assert (prepared[0][0][:, :15] == 1).all()
    ours, theirs = matcher.match(*prepared)
    # Pixels' centres: (10 + 0.5) * 2 - 0.5.
    np.testing.assert_allclose(ours, [[20.5, 40.5], [60.5, 100.5]])
    np.testing.assert_allclose(theirs, [[190, 94], [16, 16]])


def test_an_onnx_matcher_of_any_size(tmp_path):
    shape = ("pairs", 3, "height", "width")
    matcher = OnnxMatcher(write_matcher(tmp_path / "m.onnx", shape, TensorProto.FLOAT16))
    tensor, factors = matcher.prepare(np.zeros((256, 1024, 3), np.uint8))
    assert tensor.shape == (3, 512, 512)
    assert factors.tolist() == [2, 0.5]
    assert len(matcher.match((tensor, factors), (tensor, factors))[0]) == 2
    other = OnnxMatcher(write_matcher(tmp_path / "n.onnx"))
    assert other.name.startswith("onnx ")
    assert other.name != matcher.name


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"shape": (1, 3, 32, 64)}, "found inputs images [1, 3, 32, 64]"),
        ({"shape": (2, 4, 32, 64)}, "found inputs images [2, 4, 32, 64]"),
        ({"kind": TensorProto.UINT8}, "expected one input (2, 1 or 3, height, width) of floats"),
        ({"outputs": ("keypoints", "mscores")}, "outputs keypoints, mscores, expected"),
    ],
)
def test_a_program_of_another_contract(tmp_path, options, words):
    file = write_matcher(tmp_path / "m.onnx", **options)
    with pytest.raises(InputError) as caught:
        open_matcher(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert words in str(caught.value)


def test_a_program_with_other_shapes_inside(tmp_path):
    matcher = open_matcher(write_matcher(tmp_path / "m.onnx", keypoints=KEYPOINTS[:, :1]))
    prepared = matcher.prepare(np.zeros((32, 64, 3), np.uint8))
    with pytest.raises(InputError, match=r"m\.onnx: found index .* expected one input"):
        matcher.match(prepared, prepared)


def test_what_is_no_program(tmp_path):
    file = tmp_path / "m.onnx"
    file.write_text("no program")
    with pytest.raises(InputError, match=r"m\.onnx: onnxruntime cannot load it"):
        open_matcher(file)
