"""`crisalad query --watch` and `--camera`: answers as images come."""

import contextlib
import sys
from typing import TYPE_CHECKING

from crisalad_jax.cli.common import STDOUT, find_given
from crisalad_jax.data.live import Camera, FolderWatch
from crisalad_jax.retrieval.maps.live import latency_words, query_live
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.sequence import BayesFilter
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import counted, printable
from crisalad_jax.utils.signals import defer_signals

if TYPE_CHECKING:
    from crisalad_jax.checkpoints.runtime import Runtime
    from crisalad_jax.cli.query import Query
    from crisalad_jax.nn.model import Model


def run(arguments: "Query") -> None:
    """Print an answer for each image that comes, until a signal or the end of a video."""
    name = "--camera" if arguments.watch is None else "--watch"
    others = {
        "IMAGE": bool(arguments.images),
        "--camera": arguments.camera is not None and name != "--camera",
        "--gallery": arguments.gallery is not None,
        "--map-images": arguments.map_images is not None,
        "--fps": arguments.fps is not None and name == "--watch",
    }
    for other, given in others.items():
        if given:
            raise InputError(f"{name}: found beside {other}, expected only one of the two")
    if arguments.json not in (None, STDOUT):
        raise InputError(
            f"--json: found {arguments.json} with {name}, expected -: answers go to the standard "
            "output as they come"
        )
    sequence = sequence_of(arguments)
    with contextlib.ExitStack() as stack:
        # First, for its errors: loading a model takes seconds.
        if arguments.watch is not None:
            source = FolderWatch(arguments.watch)
            verb = "is" if source.there == 1 else "are"
            there = f"{counted(source.there, 'image')} {verb} there"
            words = f"watching {arguments.watch} ({there}, and left out)"
        else:
            assert arguments.camera is not None
            source = stack.enter_context(Camera(arguments.camera, fps=arguments.fps))
            words = f"taking frames from {source.name}"
        opened = Map.open(
            arguments.map, verify=arguments.verify, calibrated=arguments.min_similarity is None
        )
        places = stack.enter_context(opened)
        model = model_of(places, arguments)
        latencies: list[float] = []
        state = stack.enter_context(defer_signals())

        def ready() -> None:
            state.has_work = True  # the summary
            _say(f"ready, {words}")

        answers = query_live(
            places,
            source,
            model=model,
            k=arguments.k,
            window=arguments.window,
            min_similarity=arguments.min_similarity,
            sequence=sequence,
            ready=ready,
            check=state.check,
        )
        try:
            for answer in answers:
                print(answer.json_line(), flush=True)
                latencies.append(answer.latency_ms)
        finally:
            dropped = f"; {source.dropped} frames passed over" if source.dropped else ""
            _say(f"{latency_words(latencies)}{dropped}")


def model_of(places: Map, arguments: "Query") -> "Model | Runtime":
    """Load the map's model, or open it in the engine that the flags ask for."""
    runtime = arguments.runtime
    return places.load_model(
        find_given(arguments.weights, runtime=runtime, quiet=arguments.quiet),
        engine=runtime,
        groupings=["single" if arguments.window == 1 else "window"],
        verify=arguments.verify,
    )


def sequence_of(arguments: "Query") -> BayesFilter | None:
    """Make the filter that the flags ask for; None where they ask for none."""
    reach = arguments.sequence_reach
    if arguments.sequence is not None:
        return BayesFilter() if reach is None else BayesFilter(reach=reach)
    if reach is not None:
        raise InputError("--sequence-reach: found without --sequence bayes, expected both")
    return None


def _say(line: str) -> None:
    print(f"crisalad: {printable(line)}", file=sys.stderr, flush=True)
