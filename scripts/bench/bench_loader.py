"""Time training batches from JPEG files, compared with torch's DataLoader and Pillow; no model.

    python scripts/bench/bench_loader.py [--out docs/training]
        [--images 960] [--batch 192] [--rounds 5]

Both read the same files in the same order, as batches of 224 x 224, each image augmented by
RandAugment (3 operations at magnitude 9 of 31). Ours is what training does (`training_batches`:
OpenCV and threads); the batches hold 8-bit pixels, which the compiled step normalises. The other
side is how the public VPR code does it: a Dataset whose transforms are Pillow's decoding, Resize,
RandAugment, ToTensor, Normalize, and a DataLoader with one worker per core. (RandAugment is the
reference of the tests: torchvision's operations on Pillow images.)

The photographs are rendered (the synthetic city, sensor noise, JPEG of quality 92) at three sizes:
GSV-Cities' 400 x 300, MSLS' 640 x 480, and a phone's 1600 x 1200; a few distinct ones, repeated.
They have just been written, so disk reads are not measured. The contenders take turns, an epoch
each, on one core of this machine (each has a worker or a thread in addition to its main thread)
and on all cores; starting the workers, by forking, is included.
"""

import argparse
import collections
import contextlib
import os
import pathlib
import random
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from bench_extract import photograph
from PIL import Image
from tables import Study, Table, bars, count, flags, leave, read
from timing import PAUSE, Timed, measured, ratio, times

# After timing, which says how many devices there are.
import torch  # isort: skip

from crisalad_jax.config.preprocessing import IMAGENET_DEVIATION, IMAGENET_MEAN
from crisalad_jax.data.augmentations.rand_augment import RandAugmentConfig
from crisalad_jax.data.loader import ImageBatch, training_batches
from crisalad_jax.data.places import COLUMNS, Places, read_places
from crisalad_jax.data.samplers.base import epoch_batches
from crisalad_jax.utils.host import usable_cores
from parity.reference.augment import rand_augment

SIZES = ((300, 400), (480, 640), (1200, 1600))
DISTINCT = 40
IMAGES_PER_PLACE = 4
INPUT = (224, 224)
ONE_AND_ALL = [set(range(usable_cores()))]
if hasattr(os, "sched_setaffinity") and usable_cores() > 1:  # Linux
    ONE_AND_ALL = [{max(os.sched_getaffinity(0))}, os.sched_getaffinity(0)]
AUGMENT = RandAugmentConfig()
TORCH, OURS = "DataLoader, Pillow", "ours"


def write_tree(root: pathlib.Path, images: int, size: tuple[int, int]) -> None:
    """Write one city in the layout of GSV-Cities."""
    photographs = [photograph(number, size) for number in range(DISTINCT)]
    folder, rows = root / "Images" / "City", []
    folder.mkdir(parents=True)
    for number in range(images):
        place, view = divmod(number, IMAGES_PER_PLACE)
        rows.append(f"{place},2020,1,{view},City,1.5,2.5,pano")
        name = f"City_{place:07d}_2020_01_{view:03d}_1.5_2.5_pano.jpg"
        (folder / name).write_bytes(photographs[number % DISTINCT])
    (root / "Dataframes").mkdir()
    lines = [",".join(COLUMNS), *rows, ""]
    (root / "Dataframes" / "City.csv").write_text("\n".join(lines), encoding="utf-8")


class Photographs(torch.utils.data.Dataset[tuple[torch.Tensor, int]]):
    """Normalised images (3, height, width), each with its place."""

    def __init__(self, places: Places) -> None:
        self.places = places
        self.mean, self.deviation = (
            torch.tensor(values).view(3, 1, 1) for values in (IMAGENET_MEAN, IMAGENET_DEVIATION)
        )

    def __len__(self) -> int:
        return len(self.places.files)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, int]:
        image = Image.open(self.places.path(index)).convert("RGB")
        image = image.resize((INPUT[1], INPUT[0]), Image.Resampling.BILINEAR)
        generator = random.Random(index)
        image = rand_augment(image, AUGMENT.operations, AUGMENT.magnitude, generator)
        # Like torchvision's ToTensor.
        pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1).contiguous()
        values = pixels.to(torch.float32).div(255)
        return (values - self.mean) / self.deviation, int(self.places.image_place[index])


def epoch_of(batch: int) -> dict[str, Any]:
    return {
        "places_per_batch": batch // IMAGES_PER_PLACE,
        "images_per_place": IMAGES_PER_PLACE,
        "sampler": "within-city",
        "seed": 0,
        "epoch": 0,
    }


def by_torch(places: Places, batch: int) -> Callable[[], int]:
    def load() -> int:
        chosen = epoch_batches(places, **epoch_of(batch))
        loader = torch.utils.data.DataLoader(
            Photographs(places),
            batch_sampler=chosen.reshape(len(chosen), -1).tolist(),
            num_workers=usable_cores(),
            multiprocessing_context="fork",
        )
        return sum(len(images) for images, _ in loader)

    return load


def our_batches(places: Places, batch: int) -> Iterator[ImageBatch]:
    return training_batches(
        places, image_size=INPUT, augmentation=AUGMENT, threads=usable_cores(), **epoch_of(batch)
    )


def by_us(places: Places, batch: int) -> Callable[[], int]:
    return lambda: sum(int(one.valid.sum()) for one in our_batches(places, batch))


@contextlib.contextmanager
def on_cores(cores: set[int]) -> Iterator[None]:
    """Pin this thread, and the threads and processes that it starts, to `cores`."""
    if len(ONE_AND_ALL) == 1:
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def compare(size: tuple[int, int], arguments: argparse.Namespace) -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory(prefix="loader-") as temporary:
        root = pathlib.Path(temporary)
        write_tree(root, arguments.images, size)
        places = read_places(root)
        contenders = {
            TORCH: by_torch(places, arguments.batch),
            OURS: by_us(places, arguments.batch),
        }
        taken: dict[tuple[int, str], list[float]] = collections.defaultdict(list)
        for _ in range(arguments.rounds):
            for cores in ONE_AND_ALL:
                with on_cores(cores):
                    for name, load in contenders.items():
                        time.sleep(PAUSE)
                        started = time.perf_counter()
                        images = load()
                        taken[len(cores), name].append(
                            1e3 * (time.perf_counter() - started) / images
                        )
    return [
        {
            "size": f"{size[1]} x {size[0]}",
            "cores": len(cores),
            "contender": name,
            "ms": taken[len(cores), name],
            "faster": ratio(Timed(taken[len(cores), TORCH]), Timed(taken[len(cores), name])),
        }
        for cores in ONE_AND_ALL
        for name in contenders
    ]


def main() -> None:
    parser = flags(__doc__ or "", "docs/training")
    parser.add_argument("--images", type=count, default=960)
    parser.add_argument("--batch", type=count, default=192)
    parser.add_argument("--rounds", type=count, default=5)
    arguments = read(parser, "bench_loader")
    if arguments.batch % IMAGES_PER_PLACE or arguments.images < arguments.batch:
        parser.error(
            f"found {arguments.images} images in batches of {arguments.batch}, expected a multiple "
            f"of {IMAGES_PER_PLACE}, and at least one batch"
        )
    # The forked workers do not use JAX.
    warnings.filterwarnings("ignore", r"os\.fork\(\) was called")
    values = [value for size in SIZES for value in compare(size, arguments)]
    rows = [
        (
            value["size"],
            str(value["cores"]),
            value["contender"],
            times(value["faster"]),
        )
        for value in values
    ]
    caption = (
        f"Training batches of {arguments.batch} images with RandAugment from JPEGs of three sizes, "
        f"no model; {measured(arguments.rounds)} of an epoch of {arguments.images} images. "
        "Speedup: over a DataLoader with Pillow on the same number of cores."
    )
    header = ("files", "cores", "contender", "speedup")
    fewest = [value for value in values if value["cores"] == len(ONE_AND_ALL[0])]
    label = f"times as fast, cores: {len(ONE_AND_ALL[0])}"
    figure = bars(fewest, lambda value: value["size"], "faster", label)
    leave("bench_loader", Study(Table(header, rows, caption, 3), values, figure), arguments)


if __name__ == "__main__":
    main()
