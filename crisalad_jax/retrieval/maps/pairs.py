"""Pairs of images to match, for COLMAP and hloc: similar, consecutive or nearby ones, and loops."""

import collections
import itertools
import os
import pathlib
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.config.checks import require, takes
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.frames import file_of, moment_of
from crisalad_jax.data.metres import comparable
from crisalad_jax.data.positions import AXES
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.sources import ImageSource, open_sources
from crisalad_jax.retrieval.chunks import Descriptors, regrouped
from crisalad_jax.retrieval.describe import check_readable, described, readable, shown
from crisalad_jax.retrieval.maps.calibration import check_min_similarity
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.query import AT_ONCE
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, real_path
from crisalad_jax.utils.shapes import Float64, Int64

if TYPE_CHECKING:  # pairs among a map's images need no JAX
    from crisalad_jax.nn.model import Model

_NUMBERS = 2**25
"""Maximum number of pairs of a query and an image processed together, one byte each."""

_Pair = tuple[str, str]


@brief
class ImagePairs(NamedTuple):
    """Pairs of images to match."""

    pairs: list[_Pair]
    """Names of two images; among the images of one map, each pair is listed once, in any order."""
    root: pathlib.Path
    """Folder that names are relative to: COLMAP's image_path."""
    unreadable: list[str]
    """Names of the images that could not be read, which have no pairs."""

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write one line per pair: two names, separated by a space.

        COLMAP (`matches_importer --match_type pairs`, `pycolmap.match_image_pairs`) and hloc read
        this file.

        Args:
            path: the file.

        Raises:
            InputError: the file cannot be written.
        """
        with atomic_path(path) as temporary:
            text = "".join(f"{first} {second}\n" for first, second in self.pairs)
            temporary.write_text(text, encoding="utf-8")


@takes(places=Map)
def image_pairs(
    places: Map,
    images: str | os.PathLike[str] | None = None,
    *,
    model: "Model | Runtime | None" = None,
    k: int = 20,
    min_similarity: float = -1.0,
    min_gap: float | None = None,
    overlap: int = 0,
    within: float | None = None,
    root: str | os.PathLike[str] | None = None,
    fps: float | None = None,
    reading: Reading = Reading(),
) -> ImagePairs:
    """Choose pairs of images to match, by at least one of the rules below.

    Pairs are among the images of a map, for reconstruction, or between other images and those of
    the map, to localise the others. An image is never paired with itself.

    Args:
        places: the map, open.
        images: a source of other images (docs/how-to/image-sources.md), which the map's model
            describes; None pairs the map's images with each other.
        model: the map's model; None loads it from its recorded path (`Map.load_model`).
        k: pair each image with its k most similar ones; 0 turns this rule off.
        min_similarity: minimum similarity for rule `k`.
        min_gap: minimum seconds between images for rule `k`, by the times in their names (to find
            loop closures). Different videos or clocks count as far enough apart.
        overlap: pair each image of the map with this many that follow in its folder or video.
        within: pair images of the map that were taken at most this many metres apart.
        root: folder that names are relative to; None is that of the images or, if there are
            several, the one that contains them all.
        fps: frames per second, if `images` is a video; None is 1.
        reading: how `images` are read.

    Returns:
        The pairs of rule `overlap`, then `within`, then `k`, with each image's most similar first.

    Raises:
        InputError: a number is out of range; no rule is given; `overlap` or `within` is given with
            `images`; the map has no positions for `within`; `min_gap` is given without `k` or times
            in names; a name has spaces or a leading #; images cannot be read; or the search fails.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, Map, Model, index, init_crisalad, save_weights
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> weights = folder / "weights.safetensors"
        >>> save_weights(weights, model)
        >>> quiet = Reading(quiet=True)
        >>> _ = index(model, pictures, folder / "map", weights=weights, reading=quiet)
        >>> with Map.open(folder / "map") as places:
        ...     found = image_pairs(places, k=0, overlap=1)
        >>> found.pairs
        [('0.png', '1.png'), ('1.png', '2.png'), ('2.png', '3.png')]
        >>> found.write(folder / "pairs.txt")
    """
    check_rules(among=images is None, k=k, overlap=overlap, within=within, min_gap=min_gap)
    check_min_similarity(min_similarity)
    roots = {image.root for image in places.images}
    source = None
    if images is not None:
        (source,) = open_sources(images, fps=fps, on_bad_image=reading.on_bad_image)
        roots.add(real_path(source.root).as_posix())
    holder = real_path(root or os.path.commonpath(roots))
    outside = [each for each in sorted(roots) if not pathlib.Path(each).is_relative_to(holder)]
    require(not outside, f"root: found {holder}, expected a folder that holds {outside[:1]}")
    names = [_below(holder, image.root, image.name) for image in places.images]
    _check_names(names)
    unreadable: list[str] = []
    found: Iterable[_Pair] = ()
    if k:
        if source is None:
            queries = _stored(places, names)
        else:
            asked = [_below(holder, real_path(source.root), name) for name in source.names]
            _check_names(asked)
            queries = _described(places, source, asked, model, reading, unreadable)
        found = _similar(places, names, queries, k, min_similarity, min_gap)
    if source is None:
        rules = (_consecutive(places, names, overlap), _nearby(places, names, within), found)
        once: dict[_Pair, _Pair] = {}
        for first, second in itertools.chain(*rules):
            once.setdefault((min(first, second), max(first, second)), (first, second))
        found = once.values()
    return ImagePairs(list(found), holder, unreadable)


def check_rules(
    *, among: bool, k: int, overlap: int, within: float | None, min_gap: float | None
) -> None:
    """Check the rules of `image_pairs` as far as possible before a model is loaded.

    Args:
        among: whether pairs are among the images of one map.
        k: as in `image_pairs`, like the others.
        overlap: the next images.
        within: metres.
        min_gap: seconds.

    Raises:
        InputError: a number is out of range, no rule is given, or one is only for one map's images.
    """
    require(k >= 0, f"k: found {k}, expected at least 0")
    require(overlap >= 0, f"overlap: found {overlap}, expected at least 0")
    for name, value in (("within", within), ("min gap", min_gap)):
        require(value is None or 0 < value < np.inf, f"{name}: found {value}, expected more than 0")
    require(min_gap is None or k > 0, "min gap: found without similar images (k), expected both")
    require(
        among or not (overlap or within),
        "overlap and within: found with other images, expected them among those of one map",
    )
    require(bool(k or overlap or within), "k: found 0, expected some rule: k, overlap or within")


def _below(holder: pathlib.Path, root: str | pathlib.Path, name: str) -> str:
    return (pathlib.PurePath(root) / name).relative_to(holder).as_posix()


def _check_names(names: list[str]) -> None:
    """Check that names fit in a file of pairs, where a space separates them.

    Raises:
        InputError: a name is empty, contains whitespace, or begins with #, as comments do.
    """
    wrong = [name for name in names if name.split() != [name] or name.startswith("#")]
    if wrong:
        raise InputError(
            f"pairs: found the image name {wrong[0]!r} ({len(wrong)} such of {len(names)}), "
            "expected names without spaces or # at the beginning, as COLMAP and hloc read pairs"
        )


_Queries = Iterator[tuple[list[str], Descriptors]]
"""Names and descriptors of some images at a time."""


def _stored(places: Map, names: list[str]) -> _Queries:
    """Yield the images of a map."""
    for start, rows in regrouped(places.descriptors, _at_once(places)):
        yield names[start : start + len(rows)], rows


def _described(
    places: Map,
    source: ImageSource,
    names: list[str],
    model: "Model | Runtime | None",
    reading: Reading,
    unreadable: list[str],
) -> _Queries:
    """Yield the images of a source that can be read; the names of others go to `unreadable`."""
    describer, count = places.describer(model), len(source.paths)
    reading = reading.fitted(count)
    stream = described(describer, source.paths, reading, components=places.components)
    stream = shown(stream, "images", count, quiet=reading.quiet)
    yield from readable(stream, _at_once(places), names, unreadable)
    check_readable("images", count, count - len(unreadable))


def _at_once(places: Map) -> int:
    return max(1, min(AT_ONCE, _NUMBERS // len(places)))


def _similar(
    places: Map,
    names: list[str],
    queries: _Queries,
    k: int,
    least: float,
    min_gap: float | None,
) -> Iterator[_Pair]:
    """Yield each query with its k most similar images that it may be paired with."""
    numbers = {name: number for number, name in enumerate(names)}
    clocks: dict[str, int] = {}
    known = None if min_gap is None else _moments(names, clocks)
    for asked, rows in queries:
        excluded = np.zeros((len(rows), len(names)), bool)
        for row, name in enumerate(asked):
            if name in numbers:
                excluded[row, numbers[name]] = True
        if known is not None:
            mine = _moments(asked, clocks)
            gaps = np.abs(mine[1][:, None] - known[1])
            excluded |= (mine[0][:, None] == known[0]) & (gaps < min_gap)
        # Enough to include the k, however many of the nearest are left out.
        found = places.search(rows, k + int(excluded.sum(axis=1).max()))
        for row, (indices, similarities) in enumerate(zip(*found, strict=True)):
            right = ~excluded[row, indices] & (similarities.astype(np.float64) >= least)
            yield from ((asked[row], names[index]) for index in indices[right][:k])


def _moments(
    names: list[str], clocks: dict[str, int]
) -> tuple[Int64[np.ndarray, " image"], Float64[np.ndarray, " image"]]:
    """Read when images were taken: the number of each image's clock, and the seconds on it."""
    moments = [moment_of(name) for name in names]
    without = [name for name, moment in zip(names, moments, strict=True) if moment is None]
    if without:
        raise InputError(
            f"min gap: found {without[0]!r} without a time ({len(without)} such of "
            f"{len(names)}), expected seconds since 1970 in names, or frames of videos"
        )
    pairs = [(clocks.setdefault(at.clock, len(clocks)), at.seconds) for at in moments if at]
    numbers, seconds = zip(*pairs, strict=True)
    return np.array(numbers), np.array(seconds)


def _consecutive(places: Map, names: list[str], overlap: int) -> Iterator[_Pair]:
    """Yield each image with the next ones of its folder or, of a frame, of its video."""
    runs: dict[pathlib.Path, list[str]] = collections.defaultdict(list)
    for name, image in zip(names, places.images, strict=True):
        path = pathlib.Path(image.root, image.name)
        file = file_of(path)
        runs[path.parent if file == path else file].append(name)
    for run in runs.values():
        for number, name in enumerate(run):
            yield from ((name, other) for other in run[number + 1 : number + 1 + overlap])


def _nearby(places: Map, names: list[str], within: float | None) -> Iterator[_Pair]:
    """Yield the pairs of images that were taken at most `within` metres apart."""
    if within is None:
        return
    from scipy.spatial import KDTree  # the import takes 0.2 s

    known = [number for number, image in enumerate(places.images) if image.position]
    require(bool(known), f"within: found no positions in {places.folder}, expected some")
    points = np.array([places.images[number].position for number in known], np.float64)
    if places.axes == AXES[1]:
        points = comparable(*points.T)
    for first, second in sorted(KDTree(points).query_pairs(within)):
        yield names[known[first]], names[known[second]]
