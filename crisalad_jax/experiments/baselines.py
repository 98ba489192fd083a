"""Descriptors that need no training, to measure a model against.

Histograms of oriented gradients: Dalal and Triggs, CVPR 2005. OpenCV 5 has none in its main
modules, so only its Sobel filter is used here.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.images import read_image
from crisalad_jax.data.resize import resize_image
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.retrieval.search import search
from crisalad_jax.utils.errors import InputError

_SIDE = 128
_CELL = 8
_BINS = 9
_CELLS = _SIDE // _CELL
_BLOCK_STARTS = _CELLS - 1


def hog_descriptors(
    images: Sequence[UInt8[np.ndarray, "h w 3"]],
) -> Float32[np.ndarray, "n 8100"]:
    """Compute unit HOG descriptors of whole pictures, which may differ in size.

    Pictures are grey, of 128 x 128 pixels, with Sobel gradients. Unsigned angles fall into 9 bins,
    linearly between the two nearest. Cells have 8 x 8 pixels. Blocks of 2 x 2 cells, one cell
    apart, are divided by their L2 norms. A picture without gradients gets equal values.

    Raises:
        InputError: no images.
    """
    if len(images) == 0:
        raise InputError("images: found none, expected at least one")
    return np.stack([_hog(image) for image in images])


def hog_neighbours(benchmark: Benchmark, k: int) -> Neighbours:
    """Search a benchmark's database for the k images whose HOG is most like each query's.

    Raises:
        InputError: an image cannot be read, or what `search` raises.
    """
    database, queries = (
        hog_descriptors([read_image(path) for path in side])
        for side in (benchmark.database, benchmark.queries)
    )
    return search(database, queries, k=k)


def _hog(image: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, " 8100"]:
    grey = cv2.cvtColor(resize_image(image, (_SIDE, _SIDE)), cv2.COLOR_RGB2GRAY)
    across = cv2.Sobel(grey, cv2.CV_32F, 1, 0)
    down = cv2.Sobel(grey, cv2.CV_32F, 0, 1)
    # In units of a bin, from the centre of the first; -0.5 to 8.5.
    angle = np.arctan2(down, across) % np.pi * (_BINS / np.pi) - 0.5
    lower = np.floor(angle)
    share = angle - lower

    cell = np.arange(_SIDE) // _CELL
    cell = cell[:, None] * _CELLS + cell
    magnitude = np.hypot(across, down)
    histogram = np.zeros(_CELLS * _CELLS * _BINS)
    for bins, weights in ((lower, 1 - share), (lower + 1, share)):
        place = cell * _BINS + bins.astype(np.int64) % _BINS
        histogram += np.bincount(
            place.ravel(), (weights * magnitude).ravel(), minlength=histogram.size
        )

    cells = histogram.reshape(_CELLS, _CELLS, _BINS)
    blocks = np.concatenate(
        [
            cells[row : row + _BLOCK_STARTS, column : column + _BLOCK_STARTS]
            for row in (0, 1)
            for column in (0, 1)
        ],
        axis=-1,
    )
    norms = np.linalg.norm(blocks, axis=-1, keepdims=True)
    descriptor = np.divide(blocks, norms, out=np.zeros_like(blocks), where=norms > 0).ravel()
    if not descriptor.any():
        descriptor += 1
    return (descriptor / np.linalg.norm(descriptor)).astype(np.float32)
