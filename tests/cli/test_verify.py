"""`crisalad query --verify`, `calibrate --verify`, `evaluate --rerank local`, and bad input."""

import json

import cv2

from crisalad_jax.data.images import list_images
from tests.cli.test_calibrate import calibrate
from tests.cli.test_cli import fails, files_in, runs, succeeds
from tests.cli.test_index import query
from tests.conftest import BATCH
from tests.retrieval.verification.test_matchers import write_matcher


def test_answers_are_verified(folder, queries, tmp_path, capfd):
    one = list_images(queries)[0]
    height, width = cv2.imread(str(one)).shape[:2]
    table = succeeds(capfd, *query(folder, one, "--verify", 2, "--k", 3))
    for word in ("inliers", "confidence"):
        assert word in table
    camera = f"{width},{width},{width / 2},{height / 2},{width},{height}"
    file = tmp_path / "camera.json"
    names = ("fx", "fy", "cx", "cy", "width", "height")
    file.write_text(json.dumps(dict(zip(names, map(float, camera.split(",")), strict=True))))
    asked = ("--verify", 1, "--json", "-", "--intrinsics")
    lines = [runs(capfd, *query(folder, one, *asked, each))[0] for each in (camera, file)]
    assert lines[0] == lines[1]
    verified = json.loads(lines[0])["neighbours"][0]["verified"]
    # The query is a picture of the map, a few pixels away.
    assert verified["inliers"] > 100
    assert verified["rotation_degrees"] < 5


def test_a_matcher_of_a_file(folder, queries, tmp_path, capfd):
    """It finds two matches, which are too few for an epipolar geometry."""
    matcher = write_matcher(tmp_path / "m.onnx")
    asked = ("--verify", 1, "--json", "-", "--matcher", matcher)
    printed, _ = runs(capfd, *query(folder, list_images(queries)[0], *asked))
    verified = json.loads(printed)["neighbours"][0]["verified"]
    assert verified == {"inliers": 0, "matches": 2, "confidence": 0.0}


def test_the_gallery_shows_the_inliers(folder, queries, tmp_path, capfd):
    one = list_images(queries)[0]
    counts = []
    for more in ((), ("--verify", 1)):
        picture = tmp_path / f"{len(more)}.png"
        succeeds(capfd, *query(folder, one, "--k", 1, "--gallery", picture, *more))
        pixels = cv2.imread(str(picture)).astype(int)
        # The green of the report, blended with what is below it.
        green = pixels[..., 1] - pixels[..., [0, 2]].max(axis=-1)
        between = green[60:200, 220:250]  # of the two pictures
        counts.append((between > 30).sum())
    assert counts[0] == 0
    assert counts[1] > 100


def test_what_does_not_go_together_is_one_line(folder, queries, tmp_path, capfd):
    one = list_images(queries)[0]
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), cv2.imread(str(one)) * 0)
    for given, words in (
        (("--matcher", "m.onnx"), "--matcher: found without --verify"),
        (("--min-inliers", 0), "--min-inliers: found without --verify"),
        (("--map-images", tmp_path), "--map-images: found without --gallery, --rerun or --verify"),
        (("--verify", 0), "verify: found 0, expected at least 1"),
        (("--verify", 1, "--map-depth", tmp_path), "intrinsics: found none with map_intrinsics"),
        (("--verify", 1, "--matcher", "m.onnx"), "m.onnx"),
        (("--verify", 1, "--matcher", one), f"{one}: onnxruntime cannot load it"),
        (("--verify", 1, "--intrinsics", "1,1,1,1,9999,10"), "expected the camera's size or asp"),
        (("--verify", 1, "--intrinsics", "1,2"), "intrinsics: found '1,2', expected fx,fy,cx,cy"),
    ):
        fails(capfd, *query(folder, one, *given), words=(words,))
    printed, _ = runs(capfd, *query(folder, blank, "--verify", 1, "--json", "-"))
    assert json.loads(printed)["neighbours"][0]["verified"]["inliers"] == 0


def test_inliers_are_calibrated(folder, shared, queries, capfd):
    said = succeeds(capfd, *calibrate(folder, shared / "town", "--precision", 0.9, "--verify", 2))
    value = json.loads((folder / "calibration-verified.json").read_text())
    least = value["min_inliers"]
    assert f"verified answers with fewer than {least} inliers are unknown from now on" in said
    assert "calibration.json" not in files_in(folder)
    said = succeeds(capfd, *query(folder, queries, "--verify", 2))
    unknown = 5 - value["answered"]
    assert f"; {unknown} of 5 unknown, with fewer than {least} inliers" in said
    fails(
        capfd,
        *calibrate(folder, shared / "town", "--matcher", "m.onnx"),
        words=("--matcher: found without --verify",),
    )


def test_recall_is_measured_with_it(shared, capfd):
    given = ("--data", shared / "town", "--weights", shared / "weights.safetensors", "--quiet")
    more = ("--grouping", "single", "--batch-size", BATCH, "--rerank", "local:2")
    said = succeeds(capfd, "evaluate", *given, *more)
    assert "+ local:2" in said
    fails(capfd, "evaluate", *given, *more, "--rerank-weights", "m.onnx", words=("m.onnx",))
