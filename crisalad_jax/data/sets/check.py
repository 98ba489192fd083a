"""Identify the data set in a folder, and compare its counts with the published ones."""

import dataclasses
import os
import pathlib
import re
from collections.abc import Sequence
from typing import Any

from crisalad_jax.config.checks import PATH, require, takes
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.benchmarks.benchmark import readable_images
from crisalad_jax.data.benchmarks.msls import MSLS_CITIES, is_msls
from crisalad_jax.data.benchmarks.npy_lists import find_lists
from crisalad_jax.data.benchmarks.on_disk import SPLITS, has_sides
from crisalad_jax.data.benchmarks.utm import QUERIES
from crisalad_jax.data.places import read_places
from crisalad_jax.data.sets.table import SETS, PublishedSet, SetPart, find_set
from crisalad_jax.utils.errors import InputError, few
from crisalad_jax.utils.files import real_path


@dataclasses.dataclass(frozen=True)
class CheckedPart:
    """A part of a folder: a split, or a folder of queries."""

    name: str
    """Name of the part from `open_benchmark`, or its location if it cannot be opened."""
    database: int | None = None
    """Number of database or training images."""
    queries: int | None = None
    """Number of queries, or of training places."""
    known: str | None = None
    """The published set and part with these counts; None if there is none."""
    problem: str | None = None
    """What is missing, unreadable or not as published; None if nothing is."""


@dataclasses.dataclass(frozen=True)
class CheckedFolder:
    """The result of checking a folder."""

    parts: tuple[CheckedPart, ...]
    absent: tuple[str, ...] = ()
    """Parts of the expected set that are missing."""

    @property
    def problems(self) -> tuple[str, ...]:
        """Problems of the parts, each with the name of its part."""
        return tuple(f"{each.name}: {each.problem}" for each in self.parts if each.problem)


@takes(folder=PATH)
def check_set(
    folder: str | os.PathLike[str],
    expected: str | None = None,
    *,
    read: bool = True,
    quiet: bool = False,
) -> CheckedFolder:
    """Count a folder's images, identify its data set, and compare with published counts.

    Every split, every folder of queries and every file of lists in the folder is opened as by
    `evaluate`; the layout of GSV-Cities is opened as by `train`.

    Args:
        folder: the folder, or one file of lists in it.
        expected: name in `SETS` of the set that the folder should hold; None allows any, and a
            custom set is then not compared.
        read: whether to decode every image too.
        quiet: whether to hide the progress bar.

    Returns:
        The parts of the folder, with their problems.

    Raises:
        InputError: there is no such set or folder, or no data in a layout of docs/datasets.md.

    Example:
        >>> import shutil
        >>> for side in ("queries", "database"):
        ...     _ = shutil.copytree(pictures, folder / "set" / side)
        >>> (part,) = check_set(folder / "set", quiet=True).parts
        >>> part.name, part.database, part.queries, part.known
        ('set (two folders, no ground truth)', 4, 4, None)
        >>> check_set(folder / "set", "sped", quiet=True).problems
        ('set (two folders, no ground truth): found 4 database images and 4 queries, expected ...',)
    """
    root = pathlib.Path(folder)
    require(root.exists(), f"{root}: found no such folder, expected one with a data set")
    published = None if expected is None else find_set(expected)
    if (root / "Dataframes").is_dir():
        return CheckedFolder((_checked_places(root, published, read=read, quiet=quiet),))
    if published is not None and published.cities:
        raise InputError(f"{root}: found no Dataframes/, expected {published.title}")
    openings = _openings(root, published)
    parts = [
        # The official queries of MSLS are among all its queries, which are read next.
        _checked(root, each, published, read=read and "layout" not in each, quiet=quiet)
        for each in openings
    ]
    names = [] if published is None else [f"{expected}, {part.name}" for part in published.parts]
    known = {name for part in parts for name in (part.known or "").split(" or ")}
    return CheckedFolder(tuple(parts), tuple(name for name in names if name not in known))


def _openings(root: pathlib.Path, published: PublishedSet | None) -> Sequence[dict[str, Any]]:
    """List the options that open each part of a folder; an option `root` is a file in it."""
    if root.is_file():
        return [{}]
    if is_msls(root):
        cities = root / "train_val" if (root / "train_val").is_dir() else root
        there = {
            split: any((cities / city).is_dir() for city in of_split)
            for split, of_split in MSLS_CITIES.items()
        }
        val = [{"layout": "msls-subtask"}, {}] if there["val"] or not there["train"] else []
        return val + [{"split": "train"}] * there["train"]
    sides = {name: root / "images" / name for name in SPLITS if (root / "images" / name).is_dir()}
    if sides or has_sides(root):
        return [
            {"split": split} | ({} if name == "queries" else {"queries": name})
            for split, folder in (sides or {None: root}).items()
            for name in sorted(path.name for path in folder.glob(f"{QUERIES}*") if path.is_dir())
            or [QUERIES]
        ]
    files = sorted({*root.glob("*.mat"), *root.glob("datasets/*.mat")})
    if published is not None:  # the .mat files of Pittsburgh 30k and 250k come together
        files = [file for file in files if file.stem.startswith(published.name)] or files
    lists = sorted(find_lists(root))
    if not files and len(lists) > 1:
        files = [root / f"{prefix}dbImages.npy" for prefix in lists]
    return [{"root": file} for file in files] or [{}]


def _checked(
    folder: pathlib.Path,
    options: dict[str, Any],
    published: PublishedSet | None,
    *,
    read: bool,
    quiet: bool,
) -> CheckedPart:
    """Open a part, and compare it with what is published."""
    options = {name: value for name, value in options.items() if value is not None}
    root = options.pop("root", folder)
    try:
        benchmark = open_benchmark(root, **options)
    except InputError as error:
        if root == folder and not options:
            raise  # not a layout of docs/datasets.md, or the only part
        return CheckedPart("/".join(map(str, options.values())) or root.name, problem=str(error))
    known = _known(benchmark, published)
    problems = [] if known else _differences(folder, benchmark, published, options)
    if read:
        problems += _unreadable((*benchmark.queries, *benchmark.database), quiet=quiet)
    counts = len(benchmark.database), len(benchmark.queries)
    return CheckedPart(benchmark.name, *counts, known, "; ".join(problems) or None)


def _known(benchmark: Benchmark, published: PublishedSet | None) -> str | None:
    """Name the published parts that match a benchmark, by its counts or its name."""
    found = []
    for each in SETS.values() if published is None else [published]:
        for part in each.parts:
            # If a part's database count is unknown, the number of queries is not proof enough.
            is_proof = published is not None or part.printed or part.database is not None
            if is_proof and _fits(part, benchmark):
                found.append(f"{each.name}, {part.name}")
    return " or ".join(found) or None


def _fits(part: SetPart, benchmark: Benchmark) -> bool:
    """Return whether a benchmark has a part's published counts and name."""
    pairs = ((part.database, benchmark.database), (part.queries, benchmark.queries))
    same = all(count is None or count == len(images) for count, images in pairs)
    return same and re.match(part.printed, benchmark.name) is not None


def _differences(
    folder: pathlib.Path,
    benchmark: Benchmark,
    published: PublishedSet | None,
    options: dict[str, Any],
) -> list[str]:
    """Describe how a benchmark differs from the expected set, or from the one its folder names."""
    published = published or SETS.get(real_path(folder).name.lower().replace("_", "-"))
    parts = () if published is None else published.parts
    split = options.get("split")
    if split is not None:  # nothing is known about a split that the table lacks
        parts = tuple(part for part in parts if part.name not in SPLITS or part.name == split)
    if published is None or not parts or "queries" in options:
        return []
    return [
        f"found {len(benchmark.database):,} database images and {len(benchmark.queries):,} queries,"
        f" expected those of {published.name}: {' or '.join(part.words for part in parts)}"
    ]


def _unreadable(paths: Sequence[pathlib.Path], *, quiet: bool) -> list[str]:
    """Decode all images, and report which cannot be read."""
    readable = readable_images(paths, quiet=quiet).tolist()
    wrong = [str(path) for path, whole in zip(paths, readable, strict=True) if not whole]
    return [f"found {len(wrong)} unreadable images: {few(wrong)}"] if wrong else []


def _checked_places(
    root: pathlib.Path, published: PublishedSet | None, *, read: bool, quiet: bool
) -> CheckedPart:
    """Check training places in the layout of GSV-Cities: whether all rows have their images."""
    whole = SETS["gsv-cities"]
    places = read_places(root, min_images=1)
    missing = sorted(set(whole.cities) - set(places.cities))
    problems = []
    if published is not None and published.cities and missing:
        problems.append(f"found {len(places.cities)} cities, expected {', '.join(missing)} too")
    if published is not None and published.parts:
        problems.append(f"found training places, expected {published.title}")
    if read:
        paths = [places.path(image) for image in range(len(places.files))]
        problems += _unreadable(paths, quiet=quiet)
    name = f"{real_path(root).name} (training places; cities: {len(places.cities)})"
    known = None if missing else f"{whole.name}, all {len(whole.cities)} cities"
    counts = len(places.files), len(places.names)
    return CheckedPart(name, *counts, known, "; ".join(problems) or None)
