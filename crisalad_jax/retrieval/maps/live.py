"""Query a map with live images, one at a time."""

import pathlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.config.checks import check_count, takes
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.live import FolderWatch, Frame, LatestFrame
from crisalad_jax.retrieval.describe import FrameDescriber
from crisalad_jax.retrieval.maps.map import Answer, Map
from crisalad_jax.retrieval.maps.query import (
    Answers,
    answers_of,
    asked_thresholds,
    asking,
    json_rows,
    json_text,
    verified,
)
from crisalad_jax.retrieval.maps.tracking import SequenceSearch
from crisalad_jax.retrieval.maps.where import Where
from crisalad_jax.retrieval.verification.verify import Verifier, Verify
from crisalad_jax.utils.output import counted

if TYPE_CHECKING:  # answers are searched without JAX
    from crisalad_jax.nn.model import Model


@brief
class LiveAnswer(NamedTuple):
    """The answer to one frame."""

    answers: Answers
    """The answers to this frame, as those to a single query."""
    frame: Frame
    """The frame: its image, its time, and how many were dropped since the previous answer."""
    latency_ms: float
    """Milliseconds from receiving the frame to the answer."""

    @property
    def known(self) -> bool:
        """Whether the frame shows a place of the map; see `Answers.known`."""
        return bool(self.answers.known[0])

    @property
    def ranked(self) -> list[Answer]:
        """The images of the map that are most similar, best first."""
        ((_, ranked),) = self.answers.rows()
        return ranked

    def json_line(self) -> str:
        """Return the answer as one line of JSON."""
        (row,) = json_rows(self.answers)
        time, latency = round(self.frame.time, 3), round(self.latency_ms, 1)
        more = {"time": time, "latency_ms": latency, "dropped": self.frame.dropped}
        return json_text({"query": row.pop("query")} | more | row)


@takes(places=Map)
def query_live(
    places: Map,
    source: LatestFrame | FolderWatch,
    *,
    model: "Model | Runtime | None" = None,
    k: int = 5,
    window: int = 1,
    min_similarity: float | None = None,
    sequence: SequenceSearch | None = None,
    where: Where | str | None = None,
    verify: Verify | None = None,
    ready: Callable[[], None] = lambda: None,
    check: Callable[[], None] = lambda: None,
) -> Iterator[LiveAnswer]:
    """Find the images of a map that are most similar to each frame of a live source.

    The programs are compiled before the first frame is taken, for frames of the source's size.
    Additions and corrections to the map take effect from the next frame on, except with `sequence`,
    which follows the camera through the map as it was opened.

    Args:
        places: the map, open.
        source: a `Camera`, a `FolderWatch`, or a `LatestFrame` that another thread fills.
        model: the model that made the map; None loads it from its recorded path (`Map.load_model`).
        k: number of answers per frame.
        window: number of frames that are described together: each with those answered just before
            it. 1 describes each independently, like a map's images.
        min_similarity: see `query`.
        sequence: see `query`; dropped frames are ignored.
        where: see `query`.
        verify: see `query`.
        ready: called once, when the first frame can be answered.
        check: called several times a second; it may raise to stop.

    Yields:
        The answer to each frame, with its latency.

    Raises:
        InputError: `model` did not make the map; a number is out of range; or the source fails.

    Example:
        >>> import jax, shutil
        >>> from crisalad_jax import (
        ...     PRESETS, FolderWatch, Map, Model, Reading, index, init_crisalad, save_weights
        ... )
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> weights = folder / "weights.safetensors"
        >>> save_weights(weights, model)
        >>> quiet = Reading(quiet=True)
        >>> _ = index(model, pictures, folder / "map", weights=weights, reading=quiet)
        >>> (folder / "new").mkdir()
        >>> watch = FolderWatch(folder / "new")
        >>> _ = shutil.copy(pictures / "2.png", folder / "new")
        >>> with Map.open(folder / "map") as places:
        ...     found = next(query_live(places, watch, k=1))
        >>> [answer.image.name for _, ranked in found.answers.rows() for answer in ranked]
        ['2.png']
    """
    check_count("k", k)
    verifier = None if verify is None else Verifier(verify)
    thresholds = asked_thresholds(places, min_similarity, verifier)
    model_describer = places.describer(model, groupings=["single" if window == 1 else "window"])
    describer = FrameDescriber(model_describer, window)

    def answers() -> Iterator[LiveAnswer]:
        now, ask = places, asking(places, k, verifier, sequence, where)
        blank = np.zeros((*(source.size or places.config.image_size), 3), np.uint8)
        places.search(places.shorten(describer(blank)), k)
        describer.forget()
        ready()
        for frame in source.frames(check):
            asked = [pathlib.Path(frame.name)]
            if sequence is None and (then := now) is not (now := then.refreshed()):
                ask = asking(now, k, verifier, None, where)
            found = ask(now.shorten(describer(frame.image)), asked)
            answer = answers_of(now, asked, [found], thresholds)
            if verifier is not None:
                answer = verified(answer, verifier, [frame.image], k)
            latency = time.perf_counter() - frame.taken
            yield LiveAnswer(answer, frame, 1000 * latency)

    return answers()


def latency_words(milliseconds: Sequence[float], dropped: int) -> str:
    """Summarise the latencies of answers, and how many frames were dropped, for a log.

    Args:
        milliseconds: the latency of each answer.
        dropped: number of frames that were dropped.

    Returns:
        The summary in one line.

    Example:
        >>> latency_words([20.0, 21.0, 22.0], 4)
        '3 answers, latency median 21.0 ms, 95th percentile 21.9 ms; 4 frames dropped'
    """
    end = f"; {counted(dropped, 'frame')} dropped" if dropped else ""
    if not milliseconds:
        return f"no answers{end}"
    median, high = np.percentile(milliseconds, (50, 95))
    return (
        f"{counted(len(milliseconds), 'answer')}, latency median {median:.1f} ms, 95th percentile "
        f"{high:.1f} ms{end}"
    )
