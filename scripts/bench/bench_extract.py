"""Time a folder of photographs to a file of descriptors, compared with torch's DataLoader.

    python scripts/bench/bench_extract.py
        [--presets s14 ...] [--images 2000] [--batch 16]

Ours is what `crisalad extract` does: list, decode, resize, describe (independently) over the CPU
devices, write. The torch side is the usual pipeline: a Dataset that reads and normalises an image,
a DataLoader with one worker per core, the reference of the parity checks with torch.compile in
inference mode, and numpy; or ONNX Runtime or OpenVINO with the file that torch exports. All have
the same random weights, and the same functions decode, resize and write. The batches are the same:
the same images in the same order, each attending only to itself, the last batch padded with unused
images. Ours goes through the folder for the tokens, then through the tokens for the descriptors;
the others do both at once.

The photographs are rendered (the synthetic city, 640 x 480, sensor noise, 90 kB each): a few
distinct ones, repeated. They have just been written, so disk reads are not measured. Both sides are
compiled, and the descriptors in their files checked to be equal, on a folder with one image more
than a batch.

Then the contenders take turns, a whole folder each; starting the workers, by forking, is included.
"Alone" is a loader whose batches are discarded: torch's are normalised, ours not yet. "Waited for"
is the time in which the next batch has been requested and is not ready, and no program is in
flight. A CPU decodes with the cores that compute, so decoding while they are busy costs no waiting
time. Busy is all processor time, including that of workers and of spinning threads.
"""

import argparse
import functools
import os
import pathlib
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar
from unittest import mock

import cv2
import numpy as np
from bench_describe import ENGINES_TOLERANCES, Sides, sides, title
from engines import onnx_file, packages, readers
from tables import Study, Table, bars, count, flags, leave, read
from timing import PAUSE, Timed, measured, ratio, times
from usual import widened

# After timing, which says how many devices there are.
import jax  # isort: skip
import torch  # isort: skip

from crisalad_jax import synthetic
from crisalad_jax.config.preprocessing import IMAGENET_DEVIATION, IMAGENET_MEAN
from crisalad_jax.data.images import list_images, read_image
from crisalad_jax.data.reading import Reading, image_batches
from crisalad_jax.data.resize import resize_image
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.model import Model
from crisalad_jax.nn.pixels import LOCAL_NOISE, LOCAL_WINDOW
from crisalad_jax.retrieval import jax_describer
from crisalad_jax.retrieval.describe import TokenSet
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.retrieval.descriptor_files import write_descriptors
from crisalad_jax.utils import compiler
from crisalad_jax.utils.host import usable_cores

SIZE = (480, 640)
DISTINCT = 50
MEAN, DEVIATION = np.array((IMAGENET_MEAN, IMAGENET_DEVIATION), np.float32)
TORCH, LOADER = "torch, DataLoader", "DataLoader alone"
LOADERS = (LOADER, "our loader alone")

_T = TypeVar("_T")


def photograph(number: int, size: tuple[int, int] = SIZE) -> bytes:
    """Encode a JPEG of the city as a camera would produce it, at (height, width)."""
    view = synthetic.View(
        season=synthetic.SEASONS[number % 4], occluders=number, noise=5.0, seed=number
    )
    picture = synthetic.render(number, view, size)
    quality = (cv2.IMWRITE_JPEG_QUALITY, 92)
    return cv2.imencode(".jpg", picture[..., ::-1], quality)[1].tobytes()


def write_photographs(folder: pathlib.Path, photographs: Sequence[bytes], count: int) -> None:
    folder.mkdir()
    for number in range(count):
        (folder / f"{number:06d}.jpg").write_bytes(photographs[number % len(photographs)])


class Watch:
    """Count the seconds spent waiting for the next batch while no program was in flight."""

    def __init__(self) -> None:
        self.waited = 0.0
        self._ended: Future[float] | None = None
        self._thread = ThreadPoolExecutor(1)

    def each(self, batches: Iterable[_T]) -> Iterator[_T]:
        stream = iter(batches)
        while True:
            asked = time.perf_counter()
            batch = next(stream, None)
            came = time.perf_counter()
            if self._ended is None:
                self.waited += came - asked
            elif self._ended.done():
                self.waited += max(0.0, came - max(asked, self._ended.result()))
            if batch is None:
                return
            yield batch

    def program(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a call whose work continues after it returns, and record when that work ends."""

        def ended(found: Any) -> float:
            jax.block_until_ready(found)
            return time.perf_counter()

        def begin(*args: Any, **kwargs: Any) -> Any:
            found = call(*args, **kwargs)
            self._ended = self._thread.submit(ended, found)
            return found

        return begin


class Contender(NamedTuple):
    name: str
    run: Callable[[pathlib.Path, pathlib.Path, Watch], None]
    """Processes a folder into a file; a loader alone writes none."""


def box_mean(values: np.ndarray) -> np.ndarray:
    """Average each pixel's neighbourhood; at the border, the part of it inside the image."""
    side = (LOCAL_WINDOW, LOCAL_WINDOW)
    box = functools.partial(
        cv2.boxFilter, ddepth=-1, ksize=side, normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    return box(values) / box(np.ones_like(values))


def normalised(image: np.ndarray, how: str) -> np.ndarray:
    values = image.astype(np.float32) / 255
    if how == "mean-deviation":
        return (values - MEAN) / DEVIATION
    centred = values - box_mean(values)
    return centred / np.sqrt(box_mean(centred**2) + LOCAL_NOISE**2)


class Photographs(torch.utils.data.Dataset[torch.Tensor]):
    """Normalised photographs (3, height, width)."""

    def __init__(self, paths: Sequence[pathlib.Path], config: ModelConfig) -> None:
        self.paths, self.config = paths, config

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> torch.Tensor:
        image = resize_image(read_image(self.paths[index]), self.config.image_size)
        values = normalised(image, self.config.preprocessing.normalisation)
        return torch.from_numpy(values).permute(2, 0, 1).contiguous()


def torch_batches(
    paths: Sequence[pathlib.Path], config: ModelConfig, batch: int
) -> torch.utils.data.DataLoader[torch.Tensor]:
    return torch.utils.data.DataLoader(
        Photographs(paths, config),
        batch_size=batch,
        num_workers=usable_cores(),
        worker_init_fn=lambda _: cv2.setNumThreads(0),
        multiprocessing_context="fork",
    )


def names(folder: pathlib.Path, paths: Sequence[pathlib.Path]) -> list[str]:
    return [path.relative_to(folder).as_posix() for path in paths]


def by_torch(both: Sides, batch: int) -> list[Contender]:
    model = torch.compile(both.theirs, dynamic=False)
    device = both.theirs_images.device
    alone = torch.eye(batch, dtype=torch.bool, device=device)

    def describe(images: torch.Tensor) -> np.ndarray:
        return model(images.to(device), alone).cpu().numpy()

    def load(folder: pathlib.Path, out: pathlib.Path, watch: Watch) -> None:
        for _ in watch.each(torch_batches(list_images(folder), both.config, batch)):
            pass

    return [Contender(TORCH, by_data_loader(both, batch, describe)), Contender(LOADER, load)]


def by_data_loader(
    both: Sides, batch: int, describe: Callable[[torch.Tensor], np.ndarray]
) -> Callable[[pathlib.Path, pathlib.Path, Watch], None]:
    """Describe a folder into a file with torch's loader and a function that describes a batch."""

    def extract(folder: pathlib.Path, out: pathlib.Path, watch: Watch) -> None:
        paths = list_images(folder)
        found = []
        with torch.inference_mode():
            for images in watch.each(torch_batches(paths, both.config, batch)):
                missing = batch - len(images)
                filled = torch.nn.functional.pad(images, (0, 0, 0, 0, 0, 0, 0, missing))
                found.append(describe(filled)[: len(images)])
        write_descriptors(out, np.concatenate(found), names(folder, paths))

    return extract


class EachAlone(torch.nn.Module):
    """A reference model in which each image attends only to itself."""

    def __init__(self, model: torch.nn.Module, batch: int) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("mask", torch.eye(batch, dtype=torch.bool))

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.model(images, self.mask)


def by_engines(both: Sides, batch: int) -> list[Contender]:
    found = readers("float32")
    if not found:
        return []
    images = np.zeros(tuple(both.theirs_images.shape), np.float32)

    def extract(run: Callable[[], np.ndarray]) -> Callable[..., None]:
        def describe(given: torch.Tensor) -> np.ndarray:
            images[:] = given.numpy()
            return run().copy()  # the next call may overwrite the results

        return by_data_loader(both, batch, describe)

    alone = EachAlone(widened(both.theirs), batch)
    with onnx_file(alone, torch.from_numpy(images)) as path:
        return [
            Contender(f"{name}, DataLoader", extract(read(path, images)))
            for name, read in found.items()
        ]


def by_us(both: Sides, batch: int) -> list[Contender]:
    def extract(folder: pathlib.Path, out: pathlib.Path, watch: Watch) -> None:
        paths = list_images(folder)
        describer, batches = describer_of(Model(both.ours, both.config)), Reading.batches
        reading = Reading(batch_size=batch, quiet=True)
        with (
            mock.patch.object(Reading, "batches", lambda *given: watch.each(batches(*given))),
            mock.patch.object(
                jax_describer, "_token_rows", watch.program(jax_describer._token_rows)
            ),
        ):
            tokens = TokenSet(describer, paths, reading)
        found = tokens.describe(tokens.batches("single", None))
        write_descriptors(out, found, names(folder, paths))

    def load(folder: pathlib.Path, out: pathlib.Path, watch: Watch) -> None:
        size = both.config.image_size
        for _ in watch.each(image_batches(list_images(folder), image_size=size, batch_size=batch)):
            pass

    return [Contender("ours", extract), Contender("our loader alone", load)]


def check(contenders: Sequence[Contender], folder: pathlib.Path, temporary: pathlib.Path) -> None:
    """Compile, and check that all files hold the descriptors of the first contender.

    Raises:
        RuntimeError: they do not.
    """
    found = []
    for number, one in enumerate(contenders):
        out = temporary / f"check{number}.npy"
        one.run(folder, out, Watch())
        found.append(np.load(out).astype(np.float64))
        off = np.abs(found[-1] - found[0]).max()
        if not off < ENGINES_TOLERANCES["float32"]:
            raise RuntimeError(f"{one.name}: differs from {contenders[0].name} by {off:.1e}")


class Run(NamedTuple):
    seconds: float
    waited: float
    """Time spent waiting for images, as a share of the total."""
    busy: float
    """Processor time, as a share of all cores' time."""


def measure(contender: Contender, folder: pathlib.Path, out: pathlib.Path) -> Run:
    time.sleep(PAUSE)
    watch = Watch()
    used, started = sum(os.times()[:4]), time.perf_counter()
    contender.run(folder, out, watch)
    seconds = time.perf_counter() - started
    busy = (sum(os.times()[:4]) - used) / (seconds * usable_cores())
    return Run(seconds, watch.waited / seconds, busy)


def compare(
    preset: str, folders: tuple[pathlib.Path, pathlib.Path], arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    """Time one model's contenders on the second folder; compile and check them on the first."""
    both = sides(PRESETS[preset], preset, arguments.batch, "float32")
    (torch_extract, torch_load), (our_extract, our_load) = (
        by(both, arguments.batch) for by in (by_torch, by_us)
    )
    small, folder = folders
    describing_all = (torch_extract, *by_engines(both, arguments.batch), our_extract)
    check(describing_all, small, small.parent)
    contenders = (*describing_all, torch_load, our_load)
    runs: dict[str, list[Run]] = {one.name: [] for one in contenders}
    for _ in range(arguments.rounds):
        for one in contenders:
            runs[one.name].append(measure(one, folder, folder.parent / "descriptors.npy"))
    torch.compiler.reset()
    timed = {name: Timed([1e3 * run.seconds for run in found]) for name, found in runs.items()}
    return [
        {
            "model": title(preset, both.config),
            "images": arguments.images,
            "contender": name,
            "ms": timed[name].rounds,
            "images per second": 1e3 * arguments.images / timed[name].median,
            "faster than torch's": ratio(timed[LOADER if name in LOADERS else TORCH], timed[name]),
            "images waited for": statistics.median(run.waited for run in found),
            "cores busy": statistics.median(run.busy for run in found),
        }
        for name, found in runs.items()
    ]


HEADER = ("model", "images", "contender", "speedup", "images waited for", "cores busy")


def row(value: dict[str, Any]) -> tuple[str, ...]:
    speed = times(value["faster than torch's"])
    if torch.cuda.is_available():
        speed += f", {value['images per second']:.0f} images/s"
    shares = (f"{100 * value[name]:.0f} %" for name in HEADER[4:])
    return value["model"], f"{value['images']}", value["contender"], speed, *shares


def main() -> None:
    parser = flags(__doc__ or "", "docs/performance")
    parser.add_argument("--presets", nargs="+", default=["tiny", "s14"], choices=PRESETS)
    parser.add_argument("--images", type=count, default=2000)
    parser.add_argument("--batch", type=count, default=16)
    parser.add_argument("--rounds", type=count, default=3)
    arguments = read(parser, "bench_extract")
    compiler.configure()
    # The forked workers do not use JAX.
    warnings.filterwarnings("ignore", r"os\.fork\(\) was called")
    values = []
    with tempfile.TemporaryDirectory(prefix="extract-") as temporary:
        small, folder = pathlib.Path(temporary, "small"), pathlib.Path(temporary, "images")
        photographs = [photograph(number) for number in range(DISTINCT)]
        write_photographs(small, photographs, arguments.batch + 1)
        write_photographs(folder, photographs, arguments.images)
        for preset in arguments.presets:
            values += compare(preset, (small, folder), arguments)
    caption = (
        f"From a folder of JPEGs ({SIZE[1]} x {SIZE[0]}) to a file of descriptors, in batches of "
        f"{arguments.batch}, float32, {measured(arguments.rounds, *packages())} of a whole "
        "folder. Speedup: over torch with its DataLoader, and for the loaders alone over "
        "DataLoader alone. Images waited for: the share of the time in which no program is in "
        "flight because the next batch is not ready. Cores busy: the share of all cores' time."
    )
    table = Table(HEADER, [row(value) for value in values], caption, 3)
    figure = bars(
        values,
        lambda value: f"{value['model']}, {value['images']} images",
        "faster than torch's",
        "times the speed of torch's",
    )
    leave("bench_extract", Study(table, values, figure), arguments)


if __name__ == "__main__":
    main()
