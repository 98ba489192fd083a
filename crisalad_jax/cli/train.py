"""`crisalad train`."""

import os
import pathlib
import re
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.runtime import read_model
from crisalad_jax.cli.common import console, fit_words, pick, refuse_with, refuse_without
from crisalad_jax.cli.flags import FOLDER, JsonFlag, PluginFlag, QuietFlag
from crisalad_jax.cli.help import asked_for
from crisalad_jax.config.checks import require
from crisalad_jax.config.flags import find_flag, flag_values, parse_settings, with_settings
from crisalad_jax.config.io import read_config
from crisalad_jax.data.file_cache import CACHE_GB
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.mixture import with_sets
from crisalad_jax.training.recipes import recipe
from crisalad_jax.utils import compiler
from crisalad_jax.utils.errors import InputError


class Train(JsonFlag, PluginFlag, QuietFlag):
    """Train on places, each with several images; resume the run in OUT if there is one."""

    data: tuple[pathlib.Path, ...]
    """Folder with a folder per place, a table name,place[,lat,lon[,heading]] (places.csv in the
    folder, or the file), or Dataframes/ and Images/ of GSV-Cities, local or at an address as in
    s3://bucket/places; for netvlad, patch-netvlad and selavpr, which mine tuples, a training set of
    queries in any layout that `evaluate` reads. Or several sets of places, as NAME=DIR NAME=DIR:
    each step takes a sub-batch of each, as --mixture.NAME.sampler, loss, share and weight say."""
    out: Annotated[pathlib.Path, FOLDER]
    """Folder of the run."""
    settings: Any
    place_radius: float | None = None
    """Radius in metres of places made from --data, a source of images with positions
    (docs/how-to/image-sources.md). No batch has two nearby places."""
    place_frames: int | None = None
    """Number of consecutive images of --data, a folder or video, in each place. No batch has two
    neighbouring places."""
    positions: pathlib.Path | None = None
    """CSV of name,east,north (metres) or name,lat,lon or name,x,y, for --place-radius; by default
    from a table given as --data, @UTM names, or EXIF data."""
    fps: float | None = None
    """Frames per second from a video or robot log as --data."""
    topic: str | None = None
    """Topic of images in a robot log as --data, by default the only one."""
    data_images: pathlib.Path | None = None
    """With a .mat file as --data: folder of its images; by default next to it."""
    val: pathlib.Path | None = None
    """Evaluation set for validations, which select the best weights and, with --patience, stop
    early; in any layout that `evaluate` reads."""
    val_images: pathlib.Path | None = None
    """With a .mat file or .npy lists as --val: folder of their images; by default next to them."""
    weights: pathlib.Path | None = None
    """Weights of a model to start from: a file, starter, or a published model's name. The run uses
    the file's model, preprocessing and image size, unless flags or --config say otherwise."""
    backbone: pathlib.Path | None = None
    """Start from only this backbone: a weight file of this package, any checkpoint that `convert`
    reads, or a published model's name, as in dinov2-vitb14."""
    preset: str = "b14"
    """Size of the model, which other flags can change: tiny, s14, b14, l14 or g14. With --weights
    it is the file's."""
    recipe: str | None = None
    """How to train. As published: crisalad (the paper; the default), crisalad-1e-4 or
    crisalad-step (its Table 2), salad, cricavpr, boq, dino-mix, edtformer, image, supervlad,
    vlad-buff, selavpr (preset l14), selavprpp, salad-cm (of two sets); over ResNet boq-resnet50,
    conv-ap, cosplace, mixvpr; over VGG netvlad, patch-netvlad. In part as published:
    eigenplaces-turns, netvlad-gsv, cosplace-vit, eigenplaces-vit; sage and megaloc (of several
    sets). From random weights: scratch, the default of tiny. starter: the second run of the model
    in this package, whose --weights are its first run's (docs/starter.md). RECIPE+PART is a recipe
    with another registered part, such as crisalad+gem."""
    config: pathlib.Path | None = None
    """Configuration of an earlier run (its config.json) to start from instead of a preset."""
    max_pixels: int = 2**28
    """Maximum pixels of an image file; larger ones are not decoded."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of the patch size; replaces --model.image-size."""
    on_bad_image: Literal["stop", "skip"] = "stop"
    """Stop at an unreadable image, or skip it (masked out of attention and loss, left out of
    validations, and counted)."""
    coordinator_address: str | None = None
    """For several processes, on one host or many, which each run this command: HOST:PORT of process
    0, or auto under Slurm, Open MPI, Kubernetes or Cloud TPU. Only process 0 writes into --out."""
    num_processes: int | None = None
    """Number of processes, with --coordinator-address HOST:PORT."""
    process_id: int | None = None
    """Number of this process, from 0, with --coordinator-address HOST:PORT."""
    local_device_ids: tuple[int, ...] | None = None
    """GPUs of this host for this process, with --coordinator-address. By default one: that of the
    process's number on its host, if Slurm, Open MPI or a coordinator at localhost gives it."""
    shard_state: bool = False
    """Shard the trainable parameters and the optimiser's moments over the devices: for --trainable
    all of a large model."""
    cache_gb: float = CACHE_GB
    """Maximum gigabytes of --data at an address (s3://...) that are cached on this host's disk, in
    CRISALAD_CACHE; processes share it, and 0 caches nothing."""
    callback: tuple[str, ...] = ()
    """Also log steps and validations elsewhere: csv (steps.csv and validations.csv
    in OUT), wandb, mlflow, or a registered callback's name."""
    num_threads: int | None = None
    """Threads that read the training images; by default one for each core that this process may
    use."""


def parse(program: str, arguments: Sequence[str]) -> Train:
    """Parse the flags, which include one for every field of the configuration and its parts."""
    return parse_settings(Train, program, arguments, defaults(arguments), preset_of(arguments))


def prepare(arguments: Sequence[str]) -> Sequence[str]:
    """Return the arguments, with the name of a model in --weights replaced by its path.

    Raises:
        InputError: the weights cannot be found or read; or several processes would download and
            convert them, which uses JAX before the processes have joined.
    """
    given = find_flag(arguments, "--weights")
    if given is None or asked_for(arguments):
        return arguments
    compiler.configure()
    several = find_flag(arguments, "--coordinator-address") is not None
    if several:
        _check_cached(given)
    try:
        weights = find_weights(given, quiet="--quiet" in arguments)
        read_model(weights)
    except InputError:
        if several:  # `train` raises it once all processes have joined, or the others would wait
            return arguments
        raise
    return [*arguments, "--weights", str(weights)]


def _check_cached(weights: str) -> None:
    """Raise InputError for the name of a published model that would be downloaded."""
    from crisalad_jax.checkpoints.cache import is_cached
    from crisalad_jax.checkpoints.published import PUBLISHED

    if weights in PUBLISHED and not is_cached(PUBLISHED[weights]):
        raise InputError(
            f"--weights: found {weights}, which is not in the cache, expected it there before "
            f"several processes start: crisalad info --weights {weights}"
        )


def command(arguments: Sequence[str]) -> type:
    """Return the class that these arguments are parsed into, for help and completion."""
    return with_settings(Train, arguments, defaults(arguments), preset_of(arguments))


def preset_of(arguments: Sequence[str]) -> str:
    """Return the name of the preset that sizes the model and its parts."""
    return find_flag(arguments, "--preset") or "b14"


def defaults(arguments: Sequence[str]) -> TrainConfig:
    """Return the configuration that the flags change.

    It comes from --config; or from --preset and --recipe, with the model of --weights if that
    file exists (`prepare` finds it). If --data names several sets, it has settings for each.

    Raises:
        InputError: --config is given with --preset or --recipe, or a given file or name is unknown.
    """
    given, data = find_flag(arguments, "--config"), flag_values(arguments, "--data")
    require(len(data) < 2, "--data: found twice, expected all sets after one: NAME=DIR NAME=DIR")
    sets = _data(data[0]) if data else None
    names = list(sets) if isinstance(sets, dict) else []
    if given is not None:
        given_too = {name: find_flag(arguments, f"--{name}") for name in ("preset", "recipe")}
        refuse_with("--config", **given_too)
        return with_sets(read_config(TrainConfig, pathlib.Path(given)), names)
    weights = find_flag(arguments, "--weights")
    model = read_model(weights) if weights is not None and os.path.isfile(weights) else None
    preset = preset_of(arguments)
    return with_sets(recipe(preset, find_flag(arguments, "--recipe"), model=model), names)


def _data(given: Sequence[str]) -> dict[str, pathlib.Path] | pathlib.Path:
    """Read --data: one path, or several by name.

    Raises:
        InputError: none, several without names, or a name twice.
    """
    pairs = [re.fullmatch(r"([A-Za-z_]\w*)=(.+)", each, re.ASCII) for each in given]
    if len(given) == 1 and pairs[0] is None:
        return pathlib.Path(given[0])
    named = {pair[1]: pathlib.Path(pair[2]) for pair in pairs if pair}
    require(
        len(named) == len(given) > 0,
        f"--data: found {' '.join(given) or 'none'}, expected one set, or "
        "NAME=DIR of each, each name once, of letters, digits and _",
    )
    return named


def run(arguments: Train) -> dict[str, Any] | None:
    """Train the model, and print how the run ended; return the result for --json."""
    from crisalad_jax.experiments.train import train
    from crisalad_jax.training import distributed
    from crisalad_jax.training.lost import filter_aborts

    address = arguments.coordinator_address
    which = pick(arguments, "num_processes", "process_id", "local_device_ids")
    refuse_without("--coordinator-address", address, **which)
    if address is not None:
        filter_aborts()
        distributed.join_processes(address, *which.values())
    console.quiet = not distributed.is_primary()
    config: TrainConfig = arguments.settings
    result = train(
        config,
        _data([str(path) for path in arguments.data]),
        arguments.out,
        images=arguments.data_images,
        validation=arguments.val,
        validation_images=arguments.val_images,
        **pick(arguments, "place_radius", "place_frames", "positions", "fps", "topic"),
        **pick(arguments, "weights", "backbone", "on_bad_image", "num_threads", "shard_state"),
        **pick(arguments, "cache_gb", "quiet"),
        callbacks=arguments.callback,
        say=lambda line: console.print(line, soft_wrap=True),
    )
    out, best = arguments.out, None
    if result.best_recall is not None:
        best = {"name": config.monitor, "recall": result.best_recall}
        best |= {"file": str(out / "best.safetensors")}
    words, curves = fit_words(result, config), out / "curves.png"
    console.print(f"{out}: {words}; curves in {curves}", soft_wrap=True)
    if not distributed.is_primary():
        return None
    return {
        "out": str(out),
        "epochs": config.epochs,
        "steps": result.steps,
        "stopped_early": result.stopped_early,
        "best": best,
        "skipped_images": result.skipped_images,
        "last": str(out / "last.safetensors"),
        "curves": str(curves),
    }
