"""Measure indexing training data of the size of GSV-Cities: time and memory; then an epoch.

    python scripts/bench/bench_index.py [--out docs/training]
        [--tree FOLDER] [--cities 23] [--places 2000] [--images 560000] [--size 64]

It writes a tree in the layout of GSV-Cities: a number of cities with a number of places each, every
place a small JPEG with a distinct pattern from several years, 560,000 images in all; in FOLDER,
where it stays and is reused, or in a temporary folder. Each image takes one file of the disk's
smallest size.

Then, in a separate process that imports nothing else: the index is read (every row of every CSV
checked, every image found), the first epoch is drawn, and its first batch of 48 places x 4 images
is read. In another process: the whole epoch, as training would read it, with RandAugment. Memory is
the peak of the process, including the interpreter and its libraries.
"""

import argparse
import contextlib
import csv
import json
import pathlib
import subprocess
import sys
import tempfile
from typing import Any

import cv2
import numpy as np
from tables import Study, Table, count, flags, leave, read

from crisalad_jax.data.places import COLUMNS
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, write_json
from crisalad_jax.utils.progress import progress_bar

LIMIT_SECONDS, LIMIT_BYTES = 10, 1e9
"""Limits on the time and the memory of the index."""
BLOCKS = 8
"""Coloured squares along a side of a place's pattern."""
_PROGRAM = """
import json, pathlib, resource, sys, time
started = time.perf_counter()
from crisalad_jax.data.augmentations.rand_augment import RandAugmentConfig
from crisalad_jax.data.loader import training_batches
from crisalad_jax.data.places import read_places
from crisalad_jax.utils.progress import progress_bar

def memory():
    # Linux counts in KiB, others in bytes.
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most * (1024 if sys.platform == "linux" else 1)

loaded, before = time.perf_counter(), memory()
places = read_places(sys.argv[1])
indexed, index_memory = time.perf_counter(), memory()
batches = training_batches(
    places, image_size=(224, 224), places_per_batch=48, images_per_place=4, sampler="within-city",
    augmentation=RandAugmentConfig(), seed=0, epoch=0,
)
next(batches)
first = time.perf_counter()
found = dict(
    images=len(places.files), places=len(places.names), cities=len(places.cities),
    imports=loaded - started, index=indexed - loaded, first_batch=first - indexed,
    memory_before=before, memory=index_memory,
)
if sys.argv[2] == "epoch":
    steps = len(places.names) // 48
    with progress_bar("epoch", steps, "steps", quiet=False, done=1) as bar:
        for batch in batches:
            assert batch.valid.all()
            bar.advance(1)
    found |= dict(steps=steps, epoch=time.perf_counter() - indexed)
else:
    batches.close()
print(json.dumps(found | dict(memory_in_all=memory())))
"""


def write_tree(root: pathlib.Path, cities: int, places: int, images: int, size: int) -> None:
    """Write a tree in the layout of GSV-Cities: `images` spread evenly over `cities` x `places`."""
    views = np.full(cities * places, images // (cities * places))
    views[: images - views.sum()] += 1
    generator = np.random.default_rng(0)
    (root / "Dataframes").mkdir(parents=True)
    with progress_bar("writing", cities * places, "places", quiet=False) as bar:
        for city in range(cities):
            name = f"City{city:02d}"
            folder = root / "Images" / name
            folder.mkdir(parents=True)
            table = root / "Dataframes" / f"{name}.csv"
            with table.open("w", newline="", encoding="utf-8") as file:
                rows = csv.writer(file)
                rows.writerow(COLUMNS)
                for place in range(places):
                    pattern = generator.integers(0, 200, (BLOCKS, BLOCKS, 3), dtype=np.uint8)
                    pattern = cv2.resize(pattern, (size, size), interpolation=cv2.INTER_CUBIC)
                    for view in range(views[city * places + place]):
                        row = _row(name, place, view)
                        ok, jpeg = cv2.imencode(".jpg", pattern + np.uint8(view))
                        assert ok
                        (folder / _file_name(row)).write_bytes(jpeg.tobytes())
                        rows.writerow(row)
                    bar.advance(1)


def _row(city: str, place: int, view: int) -> tuple[Any, ...]:
    """Make a row of COLUMNS; the position in degrees has as many digits as the published ones."""
    latitude, longitude = 40 + place / 1e5 + 1e-7 / 3, -70 - place / 1e5 - 1e-7 / 3
    panorama = f"{place:08d}_{view:03d}_abcdefghij"  # 22 characters, like Google's
    return place, 2008 + view, 1 + view % 12, 30 * view % 360, city, latitude, longitude, panorama


def _file_name(row: tuple[Any, ...]) -> str:
    place, year, month, north, city, latitude, longitude, panorama = row
    return (
        f"{city}_{place:07d}_{year:04d}_{month:02d}_{north:03d}_{latitude}_{longitude}"
        f"_{panorama}.jpg"
    )


def make_tree(root: pathlib.Path, arguments: argparse.Namespace) -> None:
    """Write the tree unless it already exists.

    Raises:
        InputError: `root` holds something else.
    """
    made_as = {name: getattr(arguments, name) for name in ("cities", "places", "images", "size")}
    done = root / "tree.json"
    if done.exists() and read_json(done, "how an index was made") == made_as:
        return
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise InputError(f"{root}: found files, expected nothing, or a tree of {made_as}")
    write_tree(root, **made_as)
    write_json(done, made_as)


def run(root: pathlib.Path, how_far: str) -> dict[str, float]:
    command = [sys.executable, "-c", _PROGRAM, str(root), how_far]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


def table(values: dict[str, dict[str, float]]) -> Table:
    index, epoch = values["index"], values["epoch"]
    seconds = index["imports"] + index["index"] + index["first_batch"]
    rows = [
        ("index", f"{index['index']:.1f} s", f"{LIMIT_SECONDS} s"),
        ("imports, index, first batch", f"{seconds:.1f} s", f"{LIMIT_SECONDS} s"),
        ("memory after the index", _megabytes(index["memory"]), _megabytes(LIMIT_BYTES)),
        ("memory before it, imports alone", _megabytes(index["memory_before"]), ""),
        ("memory after the epoch", _megabytes(epoch["memory_in_all"]), _megabytes(LIMIT_BYTES)),
    ]
    caption = (
        f"An index of {index['images']:,} images of {index['places']:,} places in "
        f"{index['cities']} cities, with files in the page cache; an epoch of "
        f"{epoch['steps']:,} steps of 192 images was then read completely, every image valid."
    )
    return Table(("what", "found", "limit"), rows, caption)


def _megabytes(size: float) -> str:
    return f"{size / 1e6:.0f} MB"


def main() -> None:
    parser = flags(__doc__ or "", "docs/training")
    parser.add_argument("--tree", type=pathlib.Path, help="folder to store and reuse the tree")
    parser.add_argument("--cities", type=count, default=23)
    parser.add_argument("--places", type=count, default=2000, help="places per city")
    parser.add_argument("--images", type=count, default=560_000, help="images in total")
    parser.add_argument("--size", type=count, default=64, help="side of an image in pixels")
    arguments = read(parser, "bench_index")
    places = arguments.cities * arguments.places
    if arguments.images < 4 * places or places < 48:
        parser.error(
            f"found {arguments.images} images of {places} places, expected at least 48 places "
            "and 4 images of each"
        )
    with contextlib.ExitStack() as stack:
        root = arguments.tree
        if root is None:
            root = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()), "tree")
        try:
            make_tree(root, arguments)
        except (InputError, OSError) as error:
            parser.error(str(error))
        values = {how_far: run(root, how_far) for how_far in ("index", "epoch")}
    leave("bench_index", Study(table(values), values), arguments)


if __name__ == "__main__":
    main()
