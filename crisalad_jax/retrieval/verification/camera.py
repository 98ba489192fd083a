"""Intrinsics of a camera, which convert pixels to directions."""

import dataclasses
import math
import os
import pathlib
from collections.abc import Mapping
from typing import Any, Self

import cv2
import numpy as np

from crisalad_jax.config.checks import require
from crisalad_jax.config.short_repr import with_field_docs
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.extras import missing_extra
from crisalad_jax.utils.files import read_text
from crisalad_jax.utils.output import one_line
from crisalad_jax.utils.shapes import Float64

_MODELS = ("", "plumb_bob", "rational_polynomial", "radtan")
"""Distortion models that OpenCV's coefficients describe; "" is none."""
_EXPECTED = (
    "fx,fy,cx,cy in pixels, with ,width,height if wanted, or a file .yaml or .json: ROS's "
    "camera_info, or fx, fy, cx, cy, width and height by name"
)


@with_field_docs
@dataclasses.dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera, with its lens distortion and image size if they are known.

    Images of another size are treated as scaled if they have the same aspect ratio.

    Example:
        >>> Intrinsics.parse("400,400,320,240,640,480").width
        640
    """

    fx: float
    """Focal length along x in pixels; `fy` is that along y, (`cx`, `cy`) the principal point."""
    fy: float
    cx: float
    cy: float
    width: int | None = None
    height: int | None = None
    distortion: tuple[float, ...] = ()
    """OpenCV's k1, k2, p1, p2, k3, ... (ROS's plumb_bob, rational_polynomial); empty for none."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        sized = (self.width is None) == (self.height is None)
        require(
            all(map(math.isfinite, numbers))
            and min(self.fx, self.fy) > 0
            and sized
            and (self.width is None or min(self.width, self.height or 0) > 0)
            and len(self.distortion) in (0, 4, 5, 8, 12, 14),
            f"intrinsics: found {self}, expected focal lengths above 0, a width and a height or "
            "neither, and 0, 4, 5, 8, 12 or 14 coefficients of distortion",
        )

    @classmethod
    def parse(cls, text: str | os.PathLike[str]) -> Self:
        """Read intrinsics from text, fx,fy,cx,cy[,width,height] in pixels, or from a camera file.

        Args:
            text: these numbers, or a YAML or JSON file: ROS's camera_info (from camera_calibration,
                or printed by `ros2 topic echo --once`), or the numbers by name.

        Raises:
            InputError: the text is neither, or the file is missing or has no intrinsics.
        """
        parts = os.fspath(text).split(",")
        if len(parts) in (4, 6):
            try:
                numbers = [float(part) for part in parts]
                return cls(*numbers[:4], *map(int, numbers[4:]))  # pyright: ignore
            except (ValueError, OverflowError) as error:
                if isinstance(error, InputError):
                    raise
        path = pathlib.Path(text)
        if not path.suffix:
            raise InputError(f"intrinsics: found {os.fspath(text)!r}, expected {_EXPECTED}")
        content = read_text(path, f"intrinsics, {_EXPECTED}")
        try:
            import yaml
        except ModuleNotFoundError as error:
            raise InputError(missing_extra(error, f"{path}")) from error
        try:
            return cls(*_fields(next(yaml.safe_load_all(content))))
        except (yaml.YAMLError, LookupError, TypeError, ValueError, StopIteration) as error:
            reason = f"found no intrinsics ({one_line(error)})"
            raise InputError(f"{path}: {reason}, expected {_EXPECTED}") from error

    def directions(
        self, points: Float64[np.ndarray, "n 2"], size: tuple[int, int], name: str
    ) -> Float64[np.ndarray, "n 2"]:
        """Convert pixels of an image to undistorted directions, x / z and y / z in camera axes.

        Args:
            points: x and y in pixels of the image.
            size: the image's height and width.
            name: name of the image, for messages.

        Raises:
            InputError: the camera's images have another aspect ratio or, if their size is unknown,
                its principal point is not in the image.
        """
        height, width = size
        factor = 1.0 if self.width is None else width / self.width
        if self.height is None:
            fits, own = 0 < self.cx < width and 0 < self.cy < height, ""
        else:
            # Rounding a scaled side changes it by less than a pixel.
            fits = abs(height - factor * self.height) < 1
            own = f"of {self.width} x {self.height} "
        require(
            fits,
            f"intrinsics: found a camera {own}with its centre at ({self.cx:g}, {self.cy:g}), and "
            f"{name} of {width} x {height}, expected the camera's size or aspect ratio",
        )
        matrix = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])
        if not len(points):
            return np.zeros((0, 2))
        own_points = (points + 0.5) / factor - 0.5
        coefficients = np.array(self.distortion)
        return cv2.undistortPoints(own_points[:, None], matrix, coefficients)[:, 0]

    def focal(self, width: int) -> float:
        """Return the mean focal length in pixels for an image that is `width` pixels wide."""
        return (self.fx + self.fy) / 2 * (1.0 if self.width is None else width / self.width)


def _fields(content: Any) -> tuple[Any, ...]:
    """Read the fields of `Intrinsics` from the content of a file, by ROS's names or ours."""
    if not isinstance(content, Mapping):
        raise TypeError(f"{type(content).__name__} in place of names and numbers")
    model = content.get("distortion_model", "")
    if model not in _MODELS:
        raise ValueError(f"distortion model {model}")
    matrix = _data(content, "camera_matrix", "k", "K")
    numbers = (content[name] for name in ("fx", "fy", "cx", "cy"))
    if matrix is not None:
        numbers = np.array(matrix)[[0, 4, 2, 5]]
    sizes = (_data(content, name, f"image_{name}") for name in ("width", "height"))
    whole = (size if size is None else int(size) for size in sizes)
    distortion = tuple(map(float, _data(content, "distortion_coefficients", "d", "D") or ()))
    return *map(float, numbers), *whole, distortion if any(distortion) else ()


def _data(content: Mapping[str, Any], *names: str) -> Any:
    """Return the numbers under the first of `names` that exists; None if none does."""
    found = next((content[name] for name in names if name in content), None)
    return found["data"] if isinstance(found, Mapping) else found
