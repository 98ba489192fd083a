"""Adapt a model to the environment of a map: train it for a few steps on the map's images."""

import dataclasses
import os
import pathlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from crisalad_jax.checkpoints.runtime import read_header
from crisalad_jax.checkpoints.weights import load_weights, save_weights
from crisalad_jax.config.checks import PATH, require, takes
from crisalad_jax.config.io import differences
from crisalad_jax.config.part import with_non_semantic_fields_of
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.places import check_grouping
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.sources import ImageSource, open_sources
from crisalad_jax.evaluation.difference import Difference, paired_difference
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.experiments.held_out import (
    CHOOSING,
    JUDGING,
    count_apart,
    held_out_benchmark,
    split_images,
    with_repeats,
)
from crisalad_jax.experiments.train import finish_run
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.remake import check_remakeable, remake_map, source_of_map
from crisalad_jax.training.callbacks import Callback
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.loop import fit
from crisalad_jax.training.run_files import check_run
from crisalad_jax.training.validation import Validator
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import real_path, write_json
from crisalad_jax.utils.shapes import Bool

Path = str | os.PathLike[str]


@brief
class Adapted(NamedTuple):
    """The gain of an adaptation on the map's places, and its change of recall on other places."""

    steps: int
    held_out: tuple[float, float]
    """Recall (`TrainConfig.monitor`) before and after, with augmented copies of the held-out images
    as queries; other copies decide when training stops."""
    others: dict[str, tuple[float, Difference]]
    """Recall@1 before the adaptation, and its change, by name of the watched evaluation set."""
    weights: pathlib.Path | None
    """File of the adapted weights; None if the held-out images gained nothing."""
    replaced: bool
    """Whether the map was rebuilt with the adapted weights."""


@takes(config=TrainConfig, folder=PATH, out=PATH)
def adapt(
    config: TrainConfig,
    folder: Path,
    out: Path,
    *,
    weights: Path | None = None,
    images: Path | Sequence[Path] = (),
    place_radius: float | None = None,
    place_frames: int | None = None,
    watch: Path | Sequence[Path] = (),
    most_lost: float = 0.005,
    replace: bool = False,
    fps: float | None = None,
    topic: str | None = None,
    reading: Reading = Reading(),
    callbacks: Sequence[Callback | str] = (),
    say: Callable[[str], None] = lambda line: None,
) -> Adapted:
    """Adapt a map's model to the map's environment, or resume the run in `out`.

    A place has the images within `place_radius` of its centre; in a map without positions, it has
    `place_frames` consecutive images, by default a single one under two augmentations. A fifth of
    the map's images, at most 100, is held out. Augmented copies of these query the rest of the map:
    two copies of each decide how long to train, and two others whether recall was gained.

    Args:
        config: the training configuration: `recipe(name="adapt", model=...)` for the map's model.
        folder: the map, whose images must be where they were indexed.
        out: folder for the run, the held-out images and `adapted.safetensors`.
        weights: file of the map's model, if it was moved; None for the path that the map records.
        images: more images of the environment to train on, as `extract` takes them; they are not
            added to the map.
        place_radius: radius of a place in metres, for a map with positions; None for 10.
        place_frames: number of consecutive images of a place, for a map without positions; None
            makes each image a place.
        watch: evaluation sets of other places, whose recall is compared before and after.
        most_lost: largest accepted drop in Recall@1 of a watched set, as a fraction; the map is
            not replaced if any drops more.
        replace: whether to rebuild the map with the adapted model; see `remake_map`.
        fps: frames per second taken from videos and robot logs among `images`; None for 1.
        topic: the topic of images in a robot log among `images`; None if it has only one.
        reading: how images are read.
        callbacks: see `fit`.
        say: called with each line of progress, for instance `print`.

    Returns:
        The gains, which are also written to `adapted.json` in `out`.

    Raises:
        InputError: the model is not the map's; images are missing or too few; `place_frames` is set
            for a map with positions, or `place_radius` for one without; `out` is within the map;
            `replace` is set, but the map cannot be rebuilt; the map was already rebuilt with the
            weights in `out`; `images` or `watch` cannot be read; or `fit` raises it.
        Interrupted: a signal stopped the run; the same call resumes it.

    Example:
        >>> import dataclasses, jax
        >>> from crisalad_jax import PRESETS, Model, index, init_crisalad, recipe, save_weights
        >>> model = Model(init_crisalad(jax.random.key(0), PRESETS["tiny"]), PRESETS["tiny"])
        >>> weights, quiet = folder / "weights.safetensors", Reading(quiet=True)
        >>> save_weights(weights, model)
        >>> _ = index(model, pictures, folder / "map", weights=weights, reading=quiet)
        >>> config = recipe("tiny", "adapt", model=model.config)
        >>> config = dataclasses.replace(config, epochs=1, places_per_batch=2)
        >>> adapt(config, folder / "map", folder / "run", reading=quiet).steps
        1
    """
    out, folder = pathlib.Path(out), pathlib.Path(folder)
    check_grouping(place_radius, place_frames)
    require(0 <= most_lost <= 1, f"--most-lost: found {most_lost:g}, expected 0 to 1")
    require(config.cities is None, "cities: found some for a map, expected None")
    inside = real_path(out).is_relative_to(real_path(folder))
    require(not inside, f"{out}: found in the map {folder}, expected a folder outside it")
    skip: Any = {"on_bad_image": reading.on_bad_image}
    quiet = dataclasses.replace(reading, quiet=True)
    watched = [watch] if isinstance(watch, str | os.PathLike) else watch
    benchmarks = [open_benchmark(each, **skip) for each in watched]
    names = [each.name for each in benchmarks]
    require(len(set(names)) == len(names), f"--watch: found {', '.join(names)}, expected each once")
    for each in benchmarks:
        each.ground_truth()
    with Map.open(folder, calibrated=False) as places:
        if replace:
            check_remakeable(folder)
        file = out / "adapted.safetensors"
        if file.exists() and read_header(file)["model_sha256"] == places.metadata.model:
            raise InputError(f"{folder}: found a map already rebuilt with {file}; see adapted.json")
        found = cast(Model, places.load_model(weights))
        _check_model(config, found, folder)
        model = Model(found.params, config.model)
        source = source_of_map(places)
        sources = [source, *_more(images, places, fps, topic, reading)]
    is_placed = source.positions is not None
    require(
        not is_placed or place_frames is None,
        f"--place-frames: found {place_frames} for a map with positions, expected --place-radius",
    )
    require(
        is_placed or place_radius is None,
        f"--place-radius: found {place_radius} for a map without positions, expected none",
    )
    radius = 10.0 if place_radius is None else place_radius
    grouping: Any = {"place_radius": radius} if is_placed else {"place_frames": place_frames}
    split = split_images(sources, config.seed, **grouping)
    count = len(split.training.names)
    require(count > 1, f"{folder}: found images of {count} place, expected several")
    # Neighbours never share a batch; half of the separate places leaves the sampler a choice.
    batch = min(config.places_per_batch, max(2, count_apart(split.training) // 2))
    config = dataclasses.replace(config, places_per_batch=batch)
    check_run(out / "run", config)
    how = "of an image each (--place-frames takes several)"
    if is_placed or place_frames is not None:
        how = f"within {radius:g} m" if is_placed else f"of {place_frames} frames"
    held = f"{len(split.answers)} images held out"
    say(f"{folder}: {count} places {how}, {batch} of them in a batch; {held}")
    benchmark, judges = (
        held_out_benchmark(config, split, out / "held-out", copies, **skip)
        for copies in (CHOOSING, JUDGING)
    )
    start = _recall(model, judges, config, reading)
    say(f"held-out frames: {config.monitor} {100 * start:.1f} before; validations use other copies")
    result = fit(
        config,
        with_repeats(split.training, config.images_per_place),
        out / "run",
        validation=benchmark,
        initial=model.params,
        num_threads=reading.threads,
        callbacks=callbacks,
        quiet=reading.quiet,
        **skip,
    )
    if result.steps:
        finish_run(out / "run", real_path(folder).name, split.training, benchmark)
    unread = len(split.answers) - len(judges.queries) // len(JUDGING)
    if unread or result.skipped_images:
        say(f"unreadable: {unread} held-out images; in training {result.skipped_images} skipped")
    new = load_weights(out / "run" / "best.safetensors", expected=config.model)
    end = _recall(new, judges, config, reading)
    gained = Adapted(result.steps, (start, end), {}, None, replaced=False)
    if end > start:
        save_weights(file, new)
        for each in benchmarks:
            before, after = (_firsts(one, each, quiet) for one in (model, new))
            change = paired_difference(after, before)
            gained.others[each.name] = float(before.mean()), change
            name = f"{each.name}: R@1 {100 * before.mean():.1f} before"
            low, high = change.interval
            say(f"{name}, {100 * change.mean:+.1f} ({100 * low:+.1f} to {100 * high:+.1f})")
        gained = gained._replace(weights=file)
    write_json(out / "adapted.json", to_json(gained))
    lost = [
        name for name, (_, change) in gained.others.items() if round(-change.mean, 9) > most_lost
    ]
    if replace and lost:
        say(f"{folder} unchanged: {', '.join(lost)} lost over {100 * most_lost:g} (--most-lost)")
    if replace and gained.weights is not None and not lost:
        remake_map(folder, new, weights=gained.weights, reading=reading)
        gained = gained._replace(replaced=True)
        write_json(out / "adapted.json", to_json(gained))
    return gained


def _check_model(config: TrainConfig, model: Model, folder: pathlib.Path) -> None:
    """Check that a map's model is the one to be trained, apart from dropout and types."""
    expected = with_non_semantic_fields_of(config.model, model.config)
    prepared = {name: getattr(model.config, name) for name in ("image_size", "preprocessing")}
    expected = dataclasses.replace(expected, **prepared)
    wrong = differences(config.model, expected)
    require(not wrong, f"{folder}: the map has another model: {'; '.join(wrong)}")


def _more(
    images: Path | Sequence[Path],
    places: Map,
    fps: float | None,
    topic: str | None,
    reading: Reading,
) -> list[ImageSource]:
    """List more images of a map's environment, with positions in the map's axes and zone."""
    if not images:
        return []
    found = open_sources(images, fps=fps, topic=topic, on_bad_image=reading.on_bad_image)
    if places.axes is None:
        return found
    axes, zone = places.axes, places.zone
    located = [each.located() for each in found]
    for each, at in zip(found, located, strict=True):
        expected = f"{', '.join(axes)} as in the map (docs/how-to/image-sources.md)"
        require(bool(at.of), f"{each.root}: found images without positions, expected {expected}")
    fitted = [at.fitted(each.root, axes, zone) for each, at in zip(found, located, strict=True)]
    return [
        each._replace(positions=at._replace(axes=axes, zone=zone))
        for each, at in zip(found, fitted, strict=True)
    ]


def _firsts(model: Model, benchmark: Benchmark, reading: Reading) -> Bool[np.ndarray, "1 q"]:
    """Return whether each query's first retrieval is correct."""
    (found,) = evaluate(model, benchmark, groupings=("single",), reading=reading)
    assert found.firsts is not None
    return found.firsts


def _recall(model: Model, benchmark: Benchmark, config: TrainConfig, reading: Reading) -> float:
    """Return the metric that the run's validations monitor, measured in the same way."""
    as_in_fit = Reading(on_bad_image=reading.on_bad_image, quiet=True)
    return Validator(config, benchmark, as_in_fit).validate(model.params).monitored


def to_json(found: Adapted) -> dict[str, Any]:
    """Convert the result of `adapt` to JSON values by name."""
    before, after = found.held_out
    others = {
        name: {"before": recall, "change": change.mean, "interval": list(change.interval)}
        for name, (recall, change) in found.others.items()
    }
    return {
        "steps": found.steps,
        "held_out": {"before": before, "after": after},
        "others": others,
        "weights": None if found.weights is None else str(found.weights),
        "replaced": found.replaced,
    }
