"""Intrinsics from flags and files, and directions against OpenCV's projection."""

import cv2
import numpy as np
import pytest

from crisalad_jax.retrieval.verification.camera import Intrinsics
from crisalad_jax.utils.errors import InputError

CALIBRATED = """
image_width: 640
image_height: 480
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [400.5, 0, 320.25, 0, 401.5, 240.75, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.3, 0.1, 0.001, -0.002, 0]
"""
ECHOED = """
header:
  frame_id: front
height: 480
width: 640
distortion_model: plumb_bob
d:
- -0.3
- 0.1
- 0.001
- -0.002
- 0.0
k:
- 400.5
- 0.0
- 320.25
- 0.0
- 401.5
- 240.75
- 0.0
- 0.0
- 1.0
---
"""
NAMED = '{"fx": 400.5, "fy": 401.5, "cx": 320.25, "cy": 240.75, "width": 640, "height": 480}'
PLAIN = Intrinsics(400.5, 401.5, 320.25, 240.75, 640, 480)
CAMERA = Intrinsics(400.5, 401.5, 320.25, 240.75, 640, 480, (-0.3, 0.1, 0.001, -0.002, 0.0))


@pytest.mark.parametrize(
    ("text", "expected"), [(CALIBRATED, CAMERA), (ECHOED, CAMERA), (NAMED, PLAIN)]
)
def test_files_of_cameras(tmp_path, text, expected):
    file = tmp_path / "camera.yaml"
    file.write_text(text)
    assert Intrinsics.parse(file) == expected


def test_numbers():
    assert Intrinsics.parse("400.5,401.5,320.25,240.75,640,480") == PLAIN
    assert Intrinsics.parse("1,2,3,4") == Intrinsics(1, 2, 3, 4)


@pytest.mark.parametrize("scale", [1, 0.5, 3])
def test_directions_are_those_that_were_projected(scale):
    """Distorted by OpenCV, in an image of the camera's size or of its aspect."""
    seen = np.random.default_rng(1).uniform((-1, -0.8, 3), (1, 0.8, 4), (50, 3))
    matrix = np.array([[400.5, 0, 320.25], [0, 401.5, 240.75], [0, 0, 1]])
    pixels = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), matrix, np.array(CAMERA.distortion))
    scaled = (pixels[0][:, 0] + 0.5) * scale - 0.5
    size = round(480 * scale), round(640 * scale)
    found = CAMERA.directions(scaled, size, "image")
    # OpenCV undoes distortion by iterations, which end 1e-4 from the fixed point here.
    np.testing.assert_allclose(found, seen[:, :2] / seen[:, 2:], atol=2e-4)
    assert CAMERA.focal(size[1]) == pytest.approx(401 * scale)


@pytest.mark.parametrize(
    ("camera", "size"), [(PLAIN, (480, 600)), (Intrinsics(400, 400, 640, 360), (480, 640))]
)
def test_intrinsics_of_another_size(camera, size):
    with pytest.raises(InputError, match=r"intrinsics: found a camera .*a\.png of .* expected the"):
        camera.directions(np.zeros((1, 2)), size, "a.png")


@pytest.mark.parametrize(
    "text",
    [
        *("", "[1, 2]", "fx: 1", "k: [1, 2]", "a: [", "distortion_model: equidistant\nfx: 1"),
        NAMED.replace("401.5", "-1"),
        NAMED.replace("401.5", '"x"'),
        NAMED.replace('"width": 640, ', ""),
        CALIBRATED.replace(", 0]\n", "]\n").replace("-0.002", "-0.002, 1, 2"),
    ],
)
def test_files_of_no_camera(tmp_path, text):
    file = tmp_path / "camera.yaml"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        Intrinsics.parse(file)
    assert str(caught.value).startswith(f"{file}: found no intrinsics")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text", ["1,2,3", "1,2,3,x", "400,400,320,240,640,0", "0,1,2,3", "nan,1,2,3"]
)
def test_numbers_of_no_camera(text):
    with pytest.raises(InputError, match=r"^intrinsics: found"):
        Intrinsics.parse(text)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match=r"none\.yaml"):
        Intrinsics.parse(tmp_path / "none.yaml")
