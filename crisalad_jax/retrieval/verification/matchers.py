"""Matchers: find points that look the same in two images."""

import functools
import os
import pathlib
from typing import Any, NamedTuple

import cv2
import numpy as np

from crisalad_jax.data.resize import resize_image
from crisalad_jax.utils.checksums import sha256_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.extras import missing_extra
from crisalad_jax.utils.files import check_source
from crisalad_jax.utils.output import one_line
from crisalad_jax.utils.shapes import Float32, Float64, UInt8

Image = UInt8[np.ndarray, "h w 3"]
Points = Float64[np.ndarray, "n 2"]
SIDE = 640
"""Longer side in pixels of images for SIFT; smaller ones are enlarged, at most twofold."""
_FEATURES = 1024
"""Maximum number of SIFT features per image."""
_CONTRAST = 0.02
"""SIFT's contrast threshold, half of OpenCV's default: thumbnails have few features above that."""
_RATIO = 0.8
"""Maximum ratio of a match's distance to the second nearest (Lowe, IJCV 2004, section 7.1)."""
_FREE_SIDES = 512, 512
"""Height and width for a program that accepts any; programs require multiples of 8, 16 or 32."""
_CONTRACT = (
    "one input (2, 1 or 3, height, width) of floats, and outputs keypoints, matches and mscores, "
    "as LightGlue-ONNX exports them"
)


class SiftFeatures(NamedTuple):
    """SIFT features of an image; points are pixels (x, y) of the image file."""

    points: Points
    descriptors: Float32[np.ndarray, "n 128"]
    """RootSIFT descriptors, which are unit vectors."""


class SiftMatcher:
    """A matcher of RootSIFT features (Lowe, IJCV 2004; Arandjelovic and Zisserman, CVPR 2012)."""

    name: str = "sift"
    """Name of the matcher; inliers of different matchers are not comparable."""

    def prepare(self, image: Image) -> SiftFeatures:
        """Compute the features of an image, independently of other images."""
        factor = min(2.0, SIDE / max(image.shape))
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        how = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=how)
        sift = cv2.SIFT.create(nfeatures=_FEATURES, contrastThreshold=_CONTRAST)
        found, rows = sift.detectAndCompute(grey, None)  # pyright: ignore
        if rows is None:
            return SiftFeatures(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
        points = np.array([point.pt for point in found])
        sums = np.maximum(rows.sum(axis=1, keepdims=True), 1)
        return SiftFeatures((points + 0.5) / factor - 0.5, np.sqrt(rows / sums, dtype=np.float32))

    def match(self, query: SiftFeatures, database: SiftFeatures) -> tuple[Points, Points]:
        """Match mutual nearest neighbours, if much nearer than the second nearest (ratio test).

        Returns:
            Pixels (x, y) of the matches in the query and in the database image, row by row.
        """
        if min(len(query.points), len(database.points)) < 2:
            return np.zeros((0, 2)), np.zeros((0, 2))
        products = query.descriptors @ database.descriptors.T
        nearest, back = products.argmax(axis=1), products.argmax(axis=0)
        second, first = np.partition(products, -2, axis=1)[:, -2:].T
        # Squared distances of unit vectors are 2 - 2 p.
        clear = 1 - first < _RATIO**2 * (1 - second)
        mutual = back[nearest] == np.arange(len(nearest))
        ours = np.flatnonzero(clear & mutual)
        return query.points[ours], database.points[nearest[ours]]


class OnnxMatcher:
    """A matcher and its features in one ONNX program, such as ALIKED or SuperPoint + LightGlue.

    The contract is that of LightGlue-ONNX (github.com/fabio-sim/LightGlue-ONNX): the input is both
    images (2, channels, height, width) from 0 to 1, RGB or grey. Outputs: `keypoints` (2, n, 2), x
    and y in these pixels; `matches` (m, 3), rows of 0 and the index of a keypoint in each image.
    """

    def __init__(self, file: pathlib.Path) -> None:
        """Load the program with onnxruntime.

        Raises:
            InputError: the file is missing, or the program does not follow the contract.
        """
        check_source(file, "a matcher (.onnx)")
        try:
            import onnxruntime
        except ModuleNotFoundError as error:
            raise InputError(missing_extra(error, f"matcher {file}")) from error
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        try:
            session = onnxruntime.InferenceSession(
                file, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime raises errors of many classes
            raise InputError(f"{file}: onnxruntime cannot load it: {one_line(error)}") from error
        inputs, outputs = session.get_inputs(), [each.name for each in session.get_outputs()]
        shape = inputs[0].shape if inputs else []
        types = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
        if (
            len(inputs) != 1
            or inputs[0].type not in types
            or len(shape) != 4
            or (isinstance(shape[0], int) and shape[0] != 2)
            or shape[1] not in (1, 3)
            or not {"keypoints", "matches", "mscores"} <= set(outputs)
        ):
            found = ", ".join(f"{each.name} {each.shape}" for each in inputs)
            raise InputError(
                f"{file}: found inputs {found}, and outputs {', '.join(outputs)}, expected "
                f"{_CONTRACT}"
            )
        sizes = zip(shape[2:], _FREE_SIDES, strict=True)
        self._sides = [side if isinstance(side, int) else free for side, free in sizes]
        self._channels, self._type = shape[1], types[inputs[0].type]
        self._run: Any = functools.partial(session.run, ["keypoints", "matches"])
        self._input, self._file = inputs[0].name, file
        self.name = f"onnx {sha256_of(file)}"

    def prepare(self, image: Image) -> tuple[np.ndarray, np.ndarray]:
        """Resize an image to the program's size; return it with its (x, y) reduction factors."""
        height, width = self._sides
        resized = resize_image(image, (height, width), filter="area")
        if self._channels == 1:
            resized = cv2.cvtColor(resized, cv2.COLOR_RGB2GRAY)[..., None]
        factors = np.array(image.shape[1::-1]) / (width, height)
        return np.moveaxis(resized, -1, 0) / 255, factors

    def match(self, query: Any, database: Any) -> tuple[Points, Points]:
        """Match two prepared images; the result is that of `SiftMatcher.match`."""
        images = np.stack([query[0], database[0]]).astype(self._type)
        try:
            keypoints, matches = self._run({self._input: images})
            pairs = zip(keypoints, matches.T[-2:], (query[1], database[1]), strict=True)
            ours, theirs = [
                (points[numbers].astype(np.float64) + 0.5) * factors - 0.5
                for points, numbers, factors in pairs
            ]
        except Exception as error:  # the program declares wrong shapes
            raise InputError(
                f"{self._file}: found {one_line(error)}, expected {_CONTRACT}"
            ) from error
        return ours, theirs


Matcher = SiftMatcher | OnnxMatcher
"""Finds matching points of two images, each of which is prepared once."""


def open_matcher(file: str | os.PathLike[str] | None) -> Matcher:
    """Open the matcher in an ONNX file; None is SIFT.

    Raises:
        InputError: the file does not exist, or is a program of another kind.
    """
    return SiftMatcher() if file is None else OnnxMatcher(pathlib.Path(file))
