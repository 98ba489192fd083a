"""`crisalad train`."""

import dataclasses
import pathlib
from typing import Annotated, Literal

import jax
import tyro

from crisalad_jax.checkpoint import load_weights
from crisalad_jax.cli.common import console
from crisalad_jax.config import TrainConfig, recipe
from crisalad_jax.convert import read_backbone
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.places import Places, read_places
from crisalad_jax.errors import InputError
from crisalad_jax.model import Crisalad, init_crisalad
from crisalad_jax.processes import leads
from crisalad_jax.serial import read_config
from crisalad_jax.vocabulary import needs_vocabulary, with_vocabulary


@dataclasses.dataclass(frozen=True)
class Train:
    """Train on places in the GSV-Cities layout; go on with the run if OUT holds one."""

    data: pathlib.Path
    """Folder with Dataframes/ and Images/."""
    out: pathlib.Path
    """Folder of the run."""
    settings: Annotated[TrainConfig, tyro.conf.arg(name="")]
    val: pathlib.Path | None = None
    """Evaluation set for early stopping, in any layout that `evaluate` reads."""
    val_images: pathlib.Path | None = None
    """Folder of the images that a .mat file or .npy lists at --val name; by default beside them."""
    weights: pathlib.Path | None = None
    """Weights of a whole model to start from; none starts from random ones."""
    backbone: pathlib.Path | None = None
    """Start from this backbone alone: a file of this package or a public checkpoint (DINOv2 .pth,
    Hugging Face Dinov2 .safetensors, DINO-SALAD .ckpt, CricaVPR .pth)."""
    preset: str = "b14"
    """tiny, s14, b14, l14 or g14: the size of the model that the other flags start from."""
    recipe: str | None = None
    """How it trains: crisalad (the paper; the default), crisalad-1e-4 or crisalad-step (its Table
    2), salad, cricavpr, netvlad, transvpr, gem, conv-ap, mixvpr, boq, cosplace, eigenplaces, or
    scratch (the default of tiny, from random weights)."""
    config: pathlib.Path | None = None
    """Configuration of an earlier run (its config.json) to start from instead of a preset."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of 14; replaces --model.image-size after all other flags."""
    on_bad_image: Literal["stop", "skip"] = "stop"
    """Stop at an unreadable image, or skip it (masked out of attention and loss, and counted)."""
    coordinator: str | None = None
    """In several processes, of one host or many, which each run this command: HOST:PORT of process
    0, or auto under Slurm, Open MPI or Kubernetes, with a process for each GPU. Process 0 alone
    writes into --out."""
    processes: int | None = None
    """How many processes there are, with --coordinator HOST:PORT."""
    process: int | None = None
    """Which of them this is, from 0."""
    split_state: bool = False
    """Keep what trains and its moments in parts, one a device, not whole on each: for --trains all
    of a large model."""
    workers: int = 0
    """Processes that read the training images; 0 reads them by threads, which is as fast on few
    cores, and keeps decoded images of small sets in memory."""
    quiet: bool = False
    """No progress bars."""


def run(arguments: Train) -> None:
    """Train, and draw the curves."""
    from crisalad_jax import processes
    from crisalad_jax.fit import check_run, check_trains, fit
    from crisalad_jax.metrics import read_metrics
    from crisalad_jax.report import training_curves

    if arguments.coordinator is not None:
        processes.join(arguments.coordinator, arguments.processes, arguments.process)
    elif (arguments.processes, arguments.process) != (None, None):
        raise InputError("--processes, --process: found no --coordinator, expected it beside them")
    console.quiet = not processes.leads()
    check_trains(arguments.settings)
    config, initial, places, validation = processes.agreed(lambda: _read(arguments))
    if (arguments.weights, arguments.backbone) == (None, None) and config.trains != "all":
        console.print(
            "Note: no --weights or --backbone, so the frozen part of the model "
            f"({config.trains} trains) is random. --trains all trains everything.",
            soft_wrap=True,
        )
    console.print(
        f"{arguments.data}: {len(places.place_id)} places, {len(places.files)} images"
        + ("" if validation is None else f"; validation on {validation.name}"),
        soft_wrap=True,
    )
    if arguments.weights is None and needs_vocabulary(config.model):
        processes.led(lambda: check_run(arguments.out, config))
        initial = processes.agreed(lambda: _with_vocabulary(initial, config, places, arguments))
        initial = processes.handed_out(initial)
    result = fit(
        config,
        places,
        arguments.out,
        validation=validation,
        initial=initial,
        on_bad_image=arguments.on_bad_image,
        workers=arguments.workers,
        split_state=arguments.split_state,
        quiet=arguments.quiet,
    )
    if not processes.leads():
        return
    picture = arguments.out / "curves.png"
    training_curves(picture, read_metrics(arguments.out / "metrics.jsonl"))
    words = f"{result.steps} steps"
    if result.stopped_early:
        words += ", stopped early"
    if result.best_recall is not None:
        words += f", best Recall@5 {100 * result.best_recall:.1f} in best.safetensors"
    if result.skipped_images:
        words += f", {result.skipped_images} unreadable images skipped"
    console.print(f"{arguments.out}: {words}; curves in {picture}", soft_wrap=True)


def _read(
    arguments: Train,
) -> tuple[TrainConfig, Crisalad | None, Places, Benchmark | None]:
    """How to train, from what (None is random parameters), on what, and what it is asked."""
    config = arguments.settings
    if arguments.image_size is not None:
        model = dataclasses.replace(config.model, image_size=arguments.image_size)
        config = dataclasses.replace(config, model=model)
    initial = _start(arguments, config)
    places = read_places(
        arguments.data, cities=config.cities, min_images=config.min_images_of_place
    )
    return config, initial, places, _validation(arguments)


def _with_vocabulary(
    initial: Crisalad | None, config: TrainConfig, places: Places, arguments: Train
) -> Crisalad:
    """Centroids of the training images: of the same start always the same, so that runs go on."""
    if initial is None:
        initial = init_crisalad(jax.random.key(config.seed), config.model)
    return with_vocabulary(
        initial,
        config.model,
        [places.path(image) for image in range(len(places.files))],
        seed=config.seed,
        on_bad_image=arguments.on_bad_image,
        quiet=arguments.quiet or not leads(),
    )


def _validation(arguments: Train) -> Benchmark | None:
    if arguments.val is None:
        if arguments.val_images is not None:
            raise InputError("--val-images: found no --val, expected it beside --val")
        return None
    return open_benchmark(arguments.val, images=arguments.val_images)


def _start(arguments: Train, config: TrainConfig) -> Crisalad | None:
    if arguments.weights is not None:
        if arguments.backbone is not None:
            raise InputError("--backbone: found beside --weights, expected only one of the two")
        params, _ = load_weights(arguments.weights, expected=config.model)
        return params
    if arguments.backbone is None:
        return None
    fresh = init_crisalad(jax.random.key(config.seed), config.model)
    backbone = read_backbone(arguments.backbone, config.model.backbone, fresh.backbone)
    return dataclasses.replace(fresh, backbone=backbone)


def defaults(arguments: list[str]) -> TrainConfig:
    """What the flags of `train` start from: --config, or --preset and --recipe, in any place."""
    given = _flag(arguments, "--config")
    if given is not None:
        for flag in ("--preset", "--recipe"):
            if _flag(arguments, flag) is not None:
                raise InputError(f"{flag}: found beside --config, expected only one of the two")
        return read_config(TrainConfig, pathlib.Path(given))
    return recipe(_flag(arguments, "--preset") or "b14", _flag(arguments, "--recipe"))


def _flag(arguments: list[str], name: str) -> str | None:
    for position, argument in enumerate(arguments):
        if argument.startswith(f"{name}="):
            return argument.partition("=")[2]
        if argument == name and position + 1 < len(arguments):
            return arguments[position + 1]
    return None
