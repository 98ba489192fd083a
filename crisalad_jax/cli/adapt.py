"""`crisalad adapt`."""

import pathlib
from collections.abc import Sequence
from typing import Annotated, Any

from crisalad_jax.cli.common import console, find_given, pick
from crisalad_jax.cli.flags import FOLDER, FrameFlags, JsonFlag, PluginFlag, ReadFlags
from crisalad_jax.config.flags import find_flag, parse_settings, with_settings
from crisalad_jax.retrieval.maps.metadata import existing_metadata, model_config
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.recipes import recipe


class Adapt(ReadFlags, FrameFlags, PluginFlag, JsonFlag):
    """Adapt a map's model to its environment in a few steps; resume the run in OUT, if any."""

    map: pathlib.Path
    """Map whose model is adapted; its images must still be where they were indexed."""
    out: Annotated[pathlib.Path, FOLDER]
    """Folder for adapted.safetensors, the run and the measurements."""
    settings: Any
    weights: pathlib.Path | None = None
    """Weights that made the map, if their file has moved since."""
    images: tuple[pathlib.Path, ...] = ()
    """More images of the place to train on, such as those of another day; they aren't added to
    the map."""
    place_radius: float | None = None
    """Radius in metres around a place's centre, for a map with positions; by default 10."""
    place_frames: int | None = None
    """Number of consecutive images in a place, for a map without positions; by default 1, which is
    seen under two augmentations."""
    watch: tuple[pathlib.Path, ...] = ()
    """Evaluation sets of other places, whose recall is compared before and after."""
    most_lost: float = 0.005
    """With --replace: keep the old map if a watched set loses more Recall@1 than this (0 to 1)."""
    replace: bool = False
    """Rebuild the map with the adapted model; the old map stays until the new one is complete."""


def parse(program: str, arguments: Sequence[str]) -> Adapt:
    """Parse the flags, which include one for every field of the configuration and its parts."""
    return parse_settings(Adapt, program, arguments, *defaults(arguments))


def command(arguments: Sequence[str]) -> type:
    """Return the class that these arguments are parsed into, for help and completion."""
    return with_settings(Adapt, arguments, *defaults(arguments))


def defaults(arguments: Sequence[str]) -> tuple[TrainConfig, str]:
    """Return the configuration that the flags change, and the name of the preset for its parts."""
    folder = find_flag(arguments, "--map")
    if folder is None or not pathlib.Path(folder).exists():
        return recipe("b14", "adapt"), "b14"
    model = model_config(existing_metadata(folder), folder)
    return recipe("b14", "adapt", model=model), "b14"


def run(arguments: Adapt) -> dict[str, Any]:
    """Adapt the model, and print the gain; return the result for --json."""
    from crisalad_jax.experiments.adapt import adapt, to_json

    config: TrainConfig = arguments.settings
    names = ("images", "place_radius", "place_frames", "watch", "most_lost", "replace")
    result = adapt(
        config,
        arguments.map,
        arguments.out,
        say=lambda line: console.print(line, soft_wrap=True),
        weights=find_given(arguments.weights, quiet=arguments.quiet),
        **pick(arguments, *names, "fps", "topic", "reading"),
    )
    before, after = result.held_out
    words = f"{result.steps} steps, held-out frames {config.monitor} {100 * before:.1f}"
    if result.weights is None:
        words += f", no better after ({100 * after:.1f}); the map's model stays"
    else:
        words += f" before, {100 * after:.1f} after; the adapted model is {result.weights}"
        words += "; the map is rebuilt" if result.replaced else ""
    console.print(f"{arguments.out}: {words}", soft_wrap=True)
    return {"out": str(arguments.out), **to_json(result)}
