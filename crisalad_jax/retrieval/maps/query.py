"""Queries to a map: which of its images are most similar to others, and where they were taken."""

import json
import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.data.images import list_images
from crisalad_jax.nn.model import Crisalad, check_params
from crisalad_jax.retrieval.describe import useful_batch_size
from crisalad_jax.retrieval.grouping import check_grouping
from crisalad_jax.retrieval.maps.build import describe_alone
from crisalad_jax.retrieval.maps.manifest import DESCRIPTION
from crisalad_jax.retrieval.maps.map import Map, MapImage
from crisalad_jax.retrieval.search import Neighbours
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path
from crisalad_jax.utils.progress import progress_bar

AT_ONCE = 1024
"""Number of queries that are searched for together: the map is read once for so many."""


class Answer(NamedTuple):
    """One image of a map, as an answer to a query."""

    rank: int
    """Rank from 1, the most similar."""
    similarity: float
    """Cosine of the two descriptors."""
    image: MapImage
    """The image: its name, and where it was taken."""


class Answers(NamedTuple):
    """The answers to some queries, by query."""

    queries: list[pathlib.Path]
    """Image files, in order."""
    neighbours: Neighbours
    """Numbers of the map's images and their similarities, (query, k), best first."""
    images: Sequence[MapImage]
    """All images of the map, by number."""
    axes: tuple[str, str] | None
    """Axes of a position's two numbers; None where no image has a position."""

    def rows(self) -> Iterator[tuple[pathlib.Path, list[Answer]]]:
        """Yield each query with its answers, best first."""
        for query, indices, similarities in zip(self.queries, *self.neighbours, strict=True):
            pairs = zip(indices, similarities, strict=True)
            yield (
                query,
                [
                    Answer(rank, float(similarity), self.images[index])
                    for rank, (index, similarity) in enumerate(pairs, 1)
                ],
            )

    def position(self, image: MapImage) -> dict[str, float] | None:
        """Return where an image was taken, by the names of the axes; None where unknown."""
        if image.position is None or self.axes is None:
            return None
        return dict(zip(self.axes, image.position, strict=True))


def query(
    places: Map,
    params: Crisalad,
    images: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    k: int = 5,
    exact: bool = False,
    batch_size: int = 16,
    quiet: bool = False,
) -> Answers:
    """Find the images of a map that are most similar to others.

    Args:
        places: the map, open.
        params: parameters of the model that made the map (`Map.load_params`).
        images: an image file, a folder, or a list of these.
        k: number of answers to each query.
        exact: whether to search exactly although the map has an approximate search.
        batch_size: number of queries described at once, each as if it were alone.
        quiet: whether to show no progress bar.

    Returns:
        The answers, of use after the map is closed too.

    Raises:
        InputError: parameters of another model; no image, or one that cannot be read; a number
            out of range; or what `Map.search` raises.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, index, init_crisalad, save_weights
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> weights = folder / "weights.safetensors"
        >>> save_weights(weights, params, config)
        >>> _ = index(params, config, pictures, folder / "map", weights=weights, quiet=True)
        >>> with Map.open(folder / "map") as places:
        ...     answers = query(places, places.load_params(), pictures / "2.png", k=1, quiet=True)
        >>> [answer.image.name for _, found in answers.rows() for answer in found]
        ['2.png']
    """
    check_grouping((), batch_size, seed=0)
    if k < 1:
        raise InputError(f"k: found {k}, expected at least 1")
    paths = _listed(images)
    batch_size = useful_batch_size(batch_size, len(paths))
    places.check_params(params)
    config = places.description.config
    try:
        check_params(params, config)
    except InputError as error:
        raise InputError(f"{places.folder / DESCRIPTION}: {error}") from error
    parts: list[Neighbours] = []
    waiting: list[np.ndarray] = []
    described = 0
    with progress_bar("queries", len(paths), "images", quiet=quiet) as bar:
        stream = describe_alone(
            params, config, paths, batch_size=batch_size, components=places.components
        )
        for part in stream:
            waiting.append(part.descriptors)
            described += len(part.indices)
            bar.advance(len(part.indices))
            if sum(map(len, waiting)) >= AT_ONCE or described == len(paths):
                parts.append(places.search(np.concatenate(waiting), k, exact=exact))
                waiting.clear()
    neighbours = Neighbours(*map(np.concatenate, zip(*parts, strict=True)))
    return Answers(paths, neighbours, places.images, places.axes)


def _listed(images: Any) -> list[pathlib.Path]:
    given = [images] if isinstance(images, str | os.PathLike) else images
    if not given:
        raise InputError("images: found none, expected images or folders of them")
    paths = map(pathlib.Path, given)
    return [image for path in paths for image in (list_images(path) if path.is_dir() else [path])]


def json_lines(answers: Answers) -> Iterator[str]:
    """Yield a line of JSON for each query: its name, and its answers' names and positions.

    Where a name has letters that no text shows, or bytes that are no UTF-8, they are escaped.
    """
    for path, ranked in answers.rows():
        neighbours = [
            {
                "rank": answer.rank,
                "name": answer.image.name,
                "similarity": round(answer.similarity, 6),
                "position": answers.position(answer.image),
            }
            for answer in ranked
        ]
        line = {"query": path.as_posix(), "neighbours": neighbours}
        text = json.dumps(line, ensure_ascii=False)
        yield text if text.isprintable() else json.dumps(line)


def write_answers(path: str | os.PathLike[str], answers: Answers) -> None:
    """Write answers as JSON, a line for each query.

    Args:
        path: the file.
        answers: what `query` found.

    Raises:
        InputError: the file cannot be made.
    """
    with (
        atomic_path(path) as temporary,
        temporary.open("w", encoding="utf-8") as file,
    ):
        file.writelines(f"{line}\n" for line in json_lines(answers))
