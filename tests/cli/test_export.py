"""`crisalad export`: what it writes and says, and for every bad input one line."""

import json

import pytest

from tests.cli.test_cli import fails, succeeds


def test_flags_become_the_manifest(tmp_path, capfd, weights):
    out = tmp_path / "export"
    said = succeeds(
        capfd,
        *("export", "--weights", weights, "--out", out),
        *("--image-size", "56", "42", "--batch-size", "2", "--grouping", "batch"),
        *("--weights-inside", "--platforms", "cpu"),
    )
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["images"]["shape"] == [2, 56, 42, 3]
    assert manifest["model"]["image_size"] == [56, 42]
    assert manifest["grouping"] == "batch"
    assert manifest["weights"] is None
    assert manifest["platforms"] == ["cpu"]
    assert said == (
        f"{out}: images uint8 (2, 56, 42, 3) -> descriptors float32 (2, 48); "
        "the images of a call attend to each other; weights inside; for cpu"
    )


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--platforms", "cpu,metal"), "platforms: found ('cpu', 'metal'), expected a tuple"),
        (("--platforms", "cpu", "--format", "onnx"), "--platforms: found with --format onnx, exp"),
        (("--image-size", "28", "28"), "4 patches for 4 clusters"),
        (("--batch-size", "0"), "batch size: found 0"),
        (("--batch-size", "some"), "--batch-size: found 'some'"),
        (("--weights", "none.safetensors"), "none.safetensors: found no such file"),
    ],
)
def test_bad_input_is_one_line(shared, tmp_path, capfd, flags, words):
    weights = () if "--weights" in flags else ("--weights", shared / "weights.safetensors")
    fails(capfd, "export", *weights, "--out", tmp_path / "out", *flags, words=(words,))
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_not_overwritten(tmp_path, capfd, weights):
    (tmp_path / "file").write_text("mine")
    for out in (tmp_path, tmp_path / "file"):
        fails(capfd, "export", "--weights", weights, "--out", out, words=(out,))
    assert (tmp_path / "file").read_text() == "mine"
