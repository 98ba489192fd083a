"""Evaluate verified answers on rendered streets, where the camera's pose is known.

    python scripts/bench/study_verification.py [--streets 20] [--pairs DATABASE QUERIES]

Each street is seen from two places of a map, 1.7 m apart, and by a query 2 to 3 m away that is
rotated by up to 15 degrees, in the same light or in another season and time. It prints table rows:
medians and processor time. --pairs counts the inliers of all pairs of two folders.
"""

import argparse
import dataclasses
import pathlib
import tempfile
import time

import cv2
import numpy as np

from crisalad_jax.data.images import list_images, read_image
from crisalad_jax.retrieval.verification.camera import Intrinsics
from crisalad_jax.retrieval.verification.verify import Verifier, Verify
from crisalad_jax.synthetic.picture import build_place, render
from crisalad_jax.synthetic.view import Camera, View

SIZES = ((120, 160), (240, 320), (480, 640), (720, 960))
FLIP = np.diag([1.0, -1, 1])
"""Converts axes from right, up, forward to OpenCV's right, down, forward."""
LIGHTS = {
    "same light": {},
    "another season": {"season": "autumn", "weather": "overcast", "repaint": 0.1},
    "night": {"time": "night"},
}


def degrees(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.rad2deg(np.arccos(np.clip((np.trace(first @ second.T) - 1) / 2, -1, 1))))


def study(folder: pathlib.Path, size: tuple[int, int], light: dict, streets: int) -> str:
    """Verify a query of each street, and return a row."""
    focal = size[1] / 2 / np.tan(np.deg2rad(40))
    camera = Intrinsics(focal, focal, size[1] / 2, size[0] / 2, size[1], size[0])
    generator, first = np.random.default_rng(0), View()
    second = View(lateral=0.8, forward=-1.5)
    rows, milliseconds = [], []
    for street in range(streets):
        turn, pitch, right, ahead = generator.uniform((-15, 6, -1, 1.8), (15, 10, 1, 2.8))
        query = View(right, ahead, turn, pitch=pitch, seed=1)
        query = dataclasses.replace(query, noise=2.0, **light)
        for number, view in enumerate((first, second)):
            cv2.imwrite(str(folder / f"{number}.png"), render(street, view, size)[..., ::-1])
        image, names = render(street, query, size), [(str(folder), f"{i}.png") for i in (0, 1)]
        poses = [Camera(build_place(street).heading, view, size) for view in (first, second, query)]
        turns = [FLIP @ pose._rotation @ FLIP for pose in poses]
        places = [np.array([pose._position[0], pose._position[2]]) for pose in poses]
        verifier = Verifier(Verify(intrinsics=camera))
        verifier.check(image, names)  # the map's features are cached from now on
        start = time.process_time()
        checks = verifier.check(image, names)
        located = verifier.locate(checks, names, places[:2], size)
        milliseconds.append(1000 * (time.process_time() - start))
        error, found, metres = np.inf, checks[0], np.inf
        if found.rotation is not None:
            error = degrees(found.rotation, turns[0] @ turns[2].T)
        if located is not None:
            metres = float(np.linalg.norm(located[0].position - places[2]))
        rows.append((found.inliers, found.confidence == 1, error, metres))
    inliers, sure, errors, metres = map(np.array, zip(*rows, strict=True))
    within = [f"{np.mean(errors < 2):.0%}", f"{np.mean(metres < 0.5):.0%}"]
    cells = [
        f"{np.median(inliers):.0f}",
        f"{np.mean(sure):.0%}",
        f"{np.median(errors):.2f}",
        within[0],
        f"{np.median(metres):.2f}",
        within[1],
        f"{np.median(milliseconds):.0f}",
    ]
    return " | ".join(cells)


def count_pairs(database: pathlib.Path, queries: pathlib.Path) -> None:
    """Print the inliers of every query with its two best images."""
    verifier, files = Verifier(Verify()), list_images(database)
    names = [(str(file.parent), file.name) for file in files]
    for query in list_images(queries):
        counts = [check.inliers for check in verifier.check(read_image(query), names)]
        best = np.argsort(-np.array(counts), kind="stable")[:2]
        print(query.name, *(f"{files[i].name}: {counts[i]}" for i in best), sep="  ")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--streets", type=int, default=20)
    parser.add_argument("--pairs", type=pathlib.Path, nargs=2)
    given = parser.parse_args()
    if given.pairs:
        count_pairs(*given.pairs)
        return
    print("light, size | inliers | confident | degrees | < 2 degrees | metres | < 0.5 m | ms")
    for name, light in LIGHTS.items():
        for size in SIZES:
            with tempfile.TemporaryDirectory() as folder:
                row = study(pathlib.Path(folder), size, light, given.streets)
            print(f"{name}, {size[1]} x {size[0]} | {row}", flush=True)


if __name__ == "__main__":
    main()
