"""`crisalad distil`."""

import dataclasses
import os
import pathlib
from collections.abc import Sequence
from typing import Annotated, Any

from crisalad_jax.checkpoints.load import find_weights, load
from crisalad_jax.checkpoints.runtime import read_model
from crisalad_jax.cli.common import console, fit_words, pick
from crisalad_jax.cli.flags import FOLDER, FrameFlags, JsonFlag, PluginFlag, ReadFlags
from crisalad_jax.cli.help import asked_for
from crisalad_jax.config.flags import find_flag, parse_settings, with_settings
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.recipes import recipe
from crisalad_jax.utils import compiler


class Distil(ReadFlags, FrameFlags, PluginFlag, JsonFlag):
    """Train a small model to reproduce a larger one's descriptors; resume the run in OUT."""

    teacher: pathlib.Path
    """Model to learn from: a file, starter, or a published model's name. It describes the images
    once, at its own image size; its descriptors are cached, also for other students."""
    student: str
    """Model to train: tiny, s14, b14, l14 or g14, whose parts other flags replace, as in
    --model.backbone resnet --model.backbone.layers 18 --model.backbone.width 32; or weights to
    start from, a file or a name."""
    out: Annotated[pathlib.Path, FOLDER]
    """Folder of the run."""
    settings: Any
    images: tuple[pathlib.Path, ...] = ()
    """Folders of any images, or other sources (docs/how-to/image-sources.md); no labels needed."""
    data: pathlib.Path | None = None
    """Labelled places instead of --images: a set of places as `train` reads it; --loss.kind.labels
    is the weight of the labels."""
    val: pathlib.Path | None = None
    """Evaluation set for validations, which select the best weights and, with --patience, stop
    early; in any layout that `evaluate` reads."""
    val_images: pathlib.Path | None = None
    """With a .mat file or .npy lists as --val: folder of their images; by default next to them."""
    image_size: tuple[int, int] | None = None
    """Image height and width of the student; replaces --model.image-size."""
    callback: tuple[str, ...] = ()
    """Also log steps and validations elsewhere, as with `train --callback`."""


def prepare(arguments: Sequence[str]) -> Sequence[str]:
    """Return the arguments, with the name of a model in --student replaced by its path.

    Raises:
        InputError: the weights cannot be found or read.
    """
    student = find_flag(arguments, "--student")
    if student is None or student in PRESETS or asked_for(arguments):
        return arguments
    compiler.configure()
    file = find_weights(student, quiet="--quiet" in arguments)
    read_model(file)
    return [*arguments, "--student", str(file)]


def parse(program: str, arguments: Sequence[str]) -> Distil:
    """Parse the flags, which include one for every field of the configuration and its parts."""
    return parse_settings(Distil, program, arguments, *defaults(arguments))


def command(arguments: Sequence[str]) -> type:
    """Return the class that these arguments are parsed into, for help and completion."""
    return with_settings(Distil, arguments, *defaults(arguments))


def defaults(arguments: Sequence[str]) -> tuple[TrainConfig, str]:
    """Return the configuration that the flags change, and the name of the preset for its parts."""
    student = find_flag(arguments, "--student") or "b14"
    preset = student if student in PRESETS else "b14"
    model = read_model(student) if os.path.isfile(student) else None
    config = recipe(preset, "distil", model=model)
    if find_flag(arguments, "--data") is not None:
        batch = {"places_per_batch": 32, "images_per_place": 2, "min_images": 2}
        config = dataclasses.replace(config, **batch)
    return config, preset


def run(arguments: Distil) -> dict[str, Any]:
    """Train the student, and print how the run ended; return the result for --json."""
    from crisalad_jax.experiments.distil import distil

    config: TrainConfig = arguments.settings
    result = distil(
        config,
        load(arguments.teacher, quiet=arguments.quiet),
        arguments.images or None,
        arguments.out,
        weights=None if arguments.student in PRESETS else pathlib.Path(arguments.student),
        validation=arguments.val,
        validation_images=arguments.val_images,
        callbacks=arguments.callback,
        say=lambda line: console.print(line, soft_wrap=True),
        **pick(arguments, "data", "fps", "topic", "reading"),
    )
    last, best = arguments.out / "last.safetensors", None
    if result.best_recall is not None:
        best = {"name": config.monitor, "recall": result.best_recall}
    words = fit_words(result, config)
    console.print(f"{arguments.out}: {words}; the student is {last}", soft_wrap=True)
    found = {"out": str(arguments.out), "steps": result.steps, "best": best, "last": str(last)}
    return found | {"skipped_images": result.skipped_images}
