"""Measure how far a descriptor moves when another library decodes and resizes the photograph.

    python scripts/bench/study_resizing.py --images FOLDER [--weights FILE | --preset tiny]

Each photograph is described after `read_image` and `prepare_image`, and after Pillow's and OpenCV's
own resizing to the same size. The table shows cosines and distances of the unit descriptors.
"""

import argparse
import pathlib
from collections.abc import Callable, Mapping

import cv2
import jax
import numpy as np
from PIL import Image

from crisalad_jax.checkpoints.load import load
from crisalad_jax.data.images import list_images, read_image
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.nn.model import Model, init_crisalad
from crisalad_jax.retrieval.describe import describe_images

Resize = Callable[[pathlib.Path, int, int], np.ndarray]


def _pillow(path: pathlib.Path, height: int, width: int) -> np.ndarray:
    image = Image.open(path).convert("RGB")
    return np.asarray(image.resize((width, height), Image.Resampling.BILINEAR))


def _opencv(interpolation: int) -> Resize:
    def resize(path: pathlib.Path, height: int, width: int) -> np.ndarray:
        image = np.asarray(cv2.imread(str(path), cv2.IMREAD_COLOR_RGB))
        return cv2.resize(image, (width, height), interpolation=interpolation)

    return resize


WAYS: Mapping[str, Resize] = {
    "Pillow, BILINEAR": _pillow,
    "cv2.resize, INTER_AREA": _opencv(cv2.INTER_AREA),
    "cv2.resize (INTER_LINEAR)": _opencv(cv2.INTER_LINEAR),
    "cv2.resize, INTER_CUBIC": _opencv(cv2.INTER_CUBIC),
}


def rows(model: Model, paths: list[pathlib.Path]) -> list[tuple[str, ...]]:
    """Return a row for each of `WAYS`: cosines (median, min) and distances (median, max)."""
    ours = describe_images(model, [read_image(path) for path in paths])
    lines = []
    for name, way in WAYS.items():
        resized = [np.ascontiguousarray(way(path, *model.config.image_size)) for path in paths]
        theirs = describe_images(model, resized)
        cosines = np.sum(ours * theirs, axis=1)
        distances = np.linalg.norm(ours - theirs, axis=1)
        words = (f"{np.median(cosines):.4f}", f"{cosines.min():.4f}")
        lines.append((name, *words, f"{np.median(distances):.1e}", f"{distances.max():.1e}"))
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--images", type=pathlib.Path, required=True)
    parser.add_argument("--weights", type=pathlib.Path)
    parser.add_argument("--preset", default="b14")
    parser.add_argument("--most", type=int, default=64)
    given = parser.parse_args()
    if given.weights is None:
        config = PRESETS[given.preset]
        model, name = Model(init_crisalad(jax.random.key(0), config), config), given.preset
    else:
        model, name = load(given.weights), given.weights
    paths = list_images(given.images)[: given.most]
    print(f"{name}: {len(paths)} photographs, resized to {model.config.image_size}\n")
    header = ("resized by", "cosine, median", "smallest", "distance, median", "largest")
    for cells in (header, ("---", *["---:"] * 4), *rows(model, paths)):
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
