"""The command line: parse, make a configuration, call the library.

Exit codes: 0 done, 2 bad arguments or input (one line on stderr), 130 interrupted, 143 told to end
(SIGTERM) and its work saved, 1 anything else.
"""

import contextlib
import dataclasses
import io
import pathlib
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Any, Literal

import jax
import rich.console
import rich.table
import tyro

from crisalad_jax import platform
from crisalad_jax.checkpoint import load_weights
from crisalad_jax.config import ModelConfig, TrainConfig, choose, recipe
from crisalad_jax.convert import convert, read_backbone
from crisalad_jax.costs import adapter_macs, paper_adapter_macs, part_costs
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.images import list_images
from crisalad_jax.data.places import Places, read_places
from crisalad_jax.descriptors import config_of, targets, writer_for
from crisalad_jax.errors import InputError, Stopped
from crisalad_jax.evaluation import GROUPINGS, check_grouping, evaluate, group, read_tokens
from crisalad_jax.files import check_target, write_json
from crisalad_jax.layouts import LAYOUTS
from crisalad_jax.model import Crisalad, init_crisalad
from crisalad_jax.serial import read_config, to_plain

# What only some commands need is imported in them, for the others to start sooner.

# Into a file or a pipe, wide enough that tables do not wrap.
_console = rich.console.Console(width=None if sys.stdout.isatty() else 120)


@dataclasses.dataclass(frozen=True)
class Demo:
    """Render a synthetic city, train a tiny model on it, and show Recall@K before and after."""

    out: pathlib.Path = pathlib.Path("demo")
    """Folder for the city, the run, the tables and the pictures."""
    seed: int = 0
    quiet: bool = False
    """No progress bars."""


def _demo(arguments: Demo) -> None:
    from crisalad_jax.demo import DemoConfig, run_demo
    from crisalad_jax.report import recall_table

    summary = run_demo(DemoConfig(seed=arguments.seed), arguments.out, quiet=arguments.quiet)
    _console.print(recall_table(summary.rows, title="Recall@K in percent, synthetic city"))
    _console.print(
        f"A descriptor of this model may depend on its batch: {_grouping_words(GROUPINGS)}.",
        soft_wrap=True,
    )
    _console.print(
        f"{summary.seconds:.0f} s in all, {summary.training_seconds:.0f} s of it training. "
        f"Pictures: {', '.join(str(p) for p in summary.pictures)}",
        soft_wrap=True,
    )


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
    weights: pathlib.Path | None = None
    """Weights of a whole model to start from; none starts from random ones."""
    backbone: pathlib.Path | None = None
    """Start from this backbone alone: a file of this package or a public checkpoint (DINOv2 .pth,
    Hugging Face Dinov2 .safetensors, DINO-SALAD .ckpt, CricaVPR .pth)."""
    preset: str = "b14"
    """tiny, s14, b14, l14 or g14: the size of the model that the other flags start from."""
    recipe: str | None = None
    """How it trains: crisalad (the paper; the default), crisalad-1e-4 or crisalad-step (its Table
    2), salad, cricavpr, or scratch (the default of tiny, from random weights)."""
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


def _train(arguments: Train) -> None:
    from crisalad_jax import processes
    from crisalad_jax.fit import fit
    from crisalad_jax.metrics import read_metrics
    from crisalad_jax.report import training_curves

    if arguments.coordinator is not None:
        processes.join(arguments.coordinator, arguments.processes, arguments.process)
    elif (arguments.processes, arguments.process) != (None, None):
        raise InputError("--processes, --process: found no --coordinator, expected it beside them")
    _console.quiet = not processes.leads()
    config, initial, places, validation = processes.agreed(lambda: _read(arguments))
    if initial is None and config.trains != "all":
        _console.print(
            "Note: no --weights or --backbone, so the frozen part of the model "
            f"({config.trains} trains) is random. --trains all trains everything.",
            soft_wrap=True,
        )
    _console.print(
        f"{arguments.data}: {len(places.place_id)} places, {len(places.files)} images"
        + ("" if validation is None else f"; validation on {validation.name}"),
        soft_wrap=True,
    )
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
    _console.print(f"{arguments.out}: {words}; curves in {picture}", soft_wrap=True)


def _read(
    arguments: Train,
) -> tuple[TrainConfig, Crisalad | None, Places, Benchmark | None]:
    """How to train, from what (None is random parameters), on what, and what it is asked."""
    config = arguments.settings
    if arguments.image_size is not None:
        model = dataclasses.replace(config.model, image_size=arguments.image_size)
        config = dataclasses.replace(config, model=model)
    initial = _start(arguments, config)
    places = read_places(arguments.data, cities=config.cities, min_images=config.min_images)
    validation = None if arguments.val is None else open_benchmark(arguments.val)
    return config, initial, places, validation


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


@dataclasses.dataclass(frozen=True)
class Convert:
    """Convert a public torch checkpoint to a file of this package, or such a file back."""

    source: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="SRC")]
    """DINOv2 .pth, Hugging Face Dinov2 .safetensors, DINO-SALAD .ckpt, CricaVPR .pth, the torch
    reference, or a file of this package."""
    target: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="DST")]
    """A .safetensors file; for a source of this package, the public checkpoint to write."""
    layout: str | None = None
    """dinov2, huggingface, dino-salad, cricavpr or reference, for a source of this package; by
    default the one its parts came from (huggingface if the target is a .safetensors)."""


def _convert(arguments: Convert) -> None:
    done = convert(arguments.source, arguments.target, arguments.layout)
    config = done.config
    backbone = config.backbone
    _console.print(
        f"{arguments.source} ({_layout_words(done.source)}) -> {arguments.target} "
        f"({_layout_words(done.target)}): backbone of width {backbone.dim}, {backbone.depth} "
        f"blocks, {backbone.registers} registers, adapter {backbone.adapter.kind}; aggregator "
        f"{config.aggregator}; {config.encoder.layers} encoder layers; descriptor of "
        f"{config.descriptor_dim} numbers",
        soft_wrap=True,
    )


def _layout_words(layout: str | None) -> str:
    return "crisalad-jax" if layout is None else LAYOUTS[layout].holds


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Print Recall@1/5/10/20 of a model on an evaluation set, under each grouping of the images."""

    data: pathlib.Path
    """Evaluation set: a folder of @UTM names, or VPR-Bench's layout."""
    weights: pathlib.Path | None = None
    """A .safetensors file of this package; none evaluates an untrained model of --preset."""
    preset: str = "b14"
    """Model to start untrained where there are no weights."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of 14; by default the model's."""
    grouping: str = ",".join(GROUPINGS)
    """Comma-separated: single, shuffled, sequential."""
    batch_size: int = 16
    """Images that a cross-image encoder sees together (the paper: 16)."""
    split: str | None = None
    """train, val or test, where the set has several."""
    radius: float = 25.0
    """Largest distance of a positive in metres, for @UTM names."""
    compute_dtype: Literal["float32", "bfloat16"] | None = None
    """Type of the matrix products, by default the model's; docs/performance.md shows what bfloat16
    gains and loses."""
    seed: int = 0
    """Draws the shuffled order, and untrained weights."""
    out: pathlib.Path | None = None
    """Folder for a gallery of retrievals and the resolved configuration."""
    json: pathlib.Path | None = None
    """File for the table as JSON."""
    quiet: bool = False
    """No progress bars."""


def _evaluate(arguments: Evaluate) -> None:
    from crisalad_jax.report import RecallRow, prediction_gallery, recall_table

    groupings = list(dict.fromkeys(arguments.grouping.split(",")))
    if arguments.json is not None:
        check_target(arguments.json)
    if arguments.out is not None:
        check_target(arguments.out / "config.json")
    check_grouping(groupings, arguments.batch_size, arguments.seed)
    params, config, model_name = _model(arguments, arguments.preset)
    benchmark = open_benchmark(arguments.data, arguments.split, arguments.radius)
    _console.print(
        f"{benchmark.name}: {len(benchmark.queries)} queries, {len(benchmark.database)} database "
        f"images; positive: {benchmark.rule}",
        soft_wrap=True,
    )
    results = evaluate(
        params,
        config,
        benchmark,
        groupings=groupings,
        batch_size=arguments.batch_size,
        seed=arguments.seed,
        quiet=arguments.quiet,
    )
    rows = [RecallRow(benchmark.name, model_name, r.grouping, r.recalls) for r in results]
    _console.print(recall_table(rows))
    if params.encoder is None:
        _console.print("No cross-image encoder: no descriptor depends on its batch.")
    else:
        _console.print(
            "A descriptor of this model depends on the images in its batch of "
            f"{arguments.batch_size}: {_grouping_words(groupings)}.",
            soft_wrap=True,
        )
    resolved = {
        "weights": None if arguments.weights is None else str(arguments.weights),
        "benchmark": benchmark.name,
        "rule": benchmark.rule,
        "batch_size": arguments.batch_size,
        "seed": arguments.seed,
        "model": to_plain(config),
    }
    if arguments.json is not None:
        table = [
            row._asdict() | {"recalls": {f"R@{k}": v for k, v in row.recalls.items()}}
            for row in rows
        ]
        write_json(arguments.json, resolved | {"results": table})
    if arguments.out is not None:
        write_json(arguments.out / "config.json", resolved)
        for result in results:
            prediction_gallery(
                arguments.out / f"gallery_{result.grouping}.png",
                benchmark.queries,
                benchmark.database,
                *result.neighbours,
                benchmark.positives,
                title=f"{benchmark.name}, {model_name}, {result.grouping}",
            )


@dataclasses.dataclass(frozen=True)
class Extract:
    """Write a descriptor of every image in a folder, in sorted path order."""

    weights: pathlib.Path
    """A .safetensors file of this package."""
    images: pathlib.Path
    """Folder, searched with its subfolders."""
    out: pathlib.Path
    """descriptors.npy (names beside it in .names.txt) or features.h5 (hloc)."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of 14; by default the model's."""
    grouping: str = "single"
    """single, shuffled or sequential: a cross-image model's descriptors depend on it."""
    batch_size: int = 16
    compute_dtype: Literal["float32", "bfloat16"] | None = None
    """Type of the matrix products, by default the model's; docs/performance.md shows what bfloat16
    gains and loses."""
    seed: int = 0
    """Draws the shuffled order."""
    on_bad_image: Literal["stop", "skip"] = "stop"
    """Stop at an unreadable image, or leave it out and say so."""
    quiet: bool = False
    """No progress bars."""


def _extract(arguments: Extract) -> None:
    write = writer_for(arguments.out)
    for target in targets(arguments.out):
        check_target(target)
    check_grouping([arguments.grouping], arguments.batch_size, arguments.seed)
    params, config, _ = _model(arguments, "")
    paths = list_images(arguments.images)
    folder = read_tokens(
        params,
        config,
        paths,
        batch_size=arguments.batch_size,
        label="images",
        on_bad_image=arguments.on_bad_image,
        quiet=arguments.quiet,
    )
    descriptors = group(
        params,
        config,
        folder,
        arguments.grouping,
        batch_size=arguments.batch_size,
        seed=arguments.seed,
    )[folder.readable]
    names = [path.relative_to(arguments.images).as_posix() for path in paths]
    skipped = [name for name, ok in zip(names, folder.readable, strict=True) if not ok]
    kept = [name for name, ok in zip(names, folder.readable, strict=True) if ok]
    if not kept:
        raise InputError(f"{arguments.images}: found {len(paths)} images, none of them readable")
    write(arguments.out, descriptors, kept)
    write_json(
        config_of(arguments.out),
        {
            "weights": str(arguments.weights),
            "images": str(arguments.images),
            "grouping": arguments.grouping,
            "batch_size": arguments.batch_size,
            "seed": arguments.seed,
            "skipped": skipped,
            "model": to_plain(config),
        },
    )
    _console.print(
        f"{arguments.out}: {len(kept)} descriptors of {config.descriptor_dim} numbers, "
        f"grouping {arguments.grouping} ({GROUPINGS[arguments.grouping]})"
        + (f"; {len(skipped)} unreadable images left out" if skipped else ""),
        soft_wrap=True,
    )


@dataclasses.dataclass(frozen=True)
class Info:
    """Print what a model is made of: parameters, what trains, multiply-accumulates an image."""

    preset: str = "b14"
    """tiny, s14, b14, l14 or g14."""
    weights: pathlib.Path | None = None
    """Describe the model in this file instead."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of 14; by default the model's."""
    trains: str | None = None
    """adapters+head, last-N-blocks+head or all; by default the recipe's."""
    batch_size: int = 16
    """Images that look at each other in the cross-image encoder."""
    json: pathlib.Path | None = None
    """File for the table as JSON."""


def _info(arguments: Info) -> None:
    from crisalad_jax.training import split_params

    check_grouping((), arguments.batch_size, seed=0)
    if arguments.json is not None:
        check_target(arguments.json)
    if arguments.weights is not None:
        _, config = load_weights(arguments.weights)
        title = str(arguments.weights)
        trains = arguments.trains or "adapters+head"
    else:
        defaults = recipe(arguments.preset)
        config, trains = defaults.model, arguments.trains or defaults.trains
        title = arguments.preset
    config = _resized(config, arguments.image_size)
    costs = part_costs(config, images=arguments.batch_size)
    total, macs = sum(c.parameters for c in costs), sum(c.macs for c in costs)
    template = jax.eval_shape(lambda key: init_crisalad(key, config), jax.random.key(0))
    trainable = jax.eval_shape(lambda params: split_params(params, trains)[0], template)
    trained = sum(leaf.size for leaf in jax.tree.leaves(trainable))
    summary = {
        "model": title,
        "image_size": list(config.image_size),
        "descriptor": config.descriptor_dim,
        "trains": trains,
        "trainable_parameters": trained,
        "frozen_parameters": total - trained,
        "parts": [cost._asdict() for cost in costs],
    }
    table = rich.table.Table(
        "part", title=f"{title} at {config.image_size[0]} x {config.image_size[1]}"
    )
    table.add_column("parameters", justify="right")
    table.add_column("multiply-accumulates an image", justify="right")
    for cost in costs:
        table.add_row(cost.part, f"{cost.parameters:,}", f"{cost.macs:,}")
    table.add_section()
    table.add_row("all", f"{total:,}", f"{macs:,}")
    _console.print(table)
    lines = [
        f"descriptor            {config.descriptor_dim:>13,} numbers",
        f"trainable             {trained:>13,} parameters ({trains})",
        f"frozen                {total - trained:>13,} parameters",
    ]
    if config.backbone.adapter.kind != "none":
        one = next(c.parameters for c in costs if c.part == "adapters") // config.backbone.depth
        true, paper = adapter_macs(config), paper_adapter_macs(config)
        summary["one_adapter"] = {"parameters": one, "macs": true, "paper_macs": paper}
        lines += [
            f"one adapter           {one:>13,} parameters",
            f"  multiply-accumulates{true:>13,} an image, linears at every token",
            f"  as the paper counts {paper:>13,} (Table 3: each linear once, convolutions at every "
            "patch)",
        ]
    _console.print("\n".join(lines), soft_wrap=True, highlight=False)
    if arguments.json is not None:
        write_json(arguments.json, summary)


def _model(arguments: Evaluate | Extract, preset: str) -> tuple[Crisalad, ModelConfig, str]:
    """A model from a file or untrained, and what to call it."""
    weights = arguments.weights
    if weights is None:
        config = recipe(preset).model
        params = init_crisalad(jax.random.key(arguments.seed), config)
        name = f"untrained {preset}, seed {arguments.seed}"
    else:
        params, config = load_weights(weights)
        name = f"{weights.parent.name}/{weights.name}" if weights.parent.name else weights.name
    if arguments.compute_dtype is not None:
        config = dataclasses.replace(config, compute_dtype=arguments.compute_dtype)
    return params, _resized(config, arguments.image_size), name


def _resized(config: ModelConfig, image_size: tuple[int, int] | None) -> ModelConfig:
    if image_size is None:
        return config
    config.check_image_size(image_size)
    return dataclasses.replace(config, image_size=image_size)


def _grouping_words(groupings: Iterable[str]) -> str:
    return "; ".join(f"{name} = {GROUPINGS[name]}" for name in groupings)


_COMMANDS: dict[str, tuple[Any, Callable[[Any], None]]] = {
    "demo": (Demo, _demo),
    "train": (Train, _train),
    "convert": (Convert, _convert),
    "evaluate": (Evaluate, _evaluate),
    "extract": (Extract, _extract),
    "info": (Info, _info),
}


def _train_defaults(arguments: list[str]) -> TrainConfig:
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


def _parse(kind: Any, given: list[str], options: dict[str, Any]) -> Any:
    """The flags as an instance of `kind`; what tyro finds wrong, in a box, becomes one line."""
    program = f"crisalad {given[0]}"
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, prog=program, args=given[1:], **options)
    except SystemExit as stop:
        if not stop.code:
            raise
        error: BaseException | None = stop
        while error is not None and not isinstance(error, InputError):
            error = error.__context__
        reason = _unboxed(complaint.getvalue()) if error is None else str(error)
        raise InputError(f"{reason} (see {program} --help)") from stop


# How the parts of tyro's boxes begin that say no more than the first.
_ASIDES = ("Argument help", "Got errors", "For full")


def _unboxed(box: str) -> str:
    """The text of one of tyro's boxes, without its frame, the helptexts and the footer."""
    sections = [[]]
    # The title goes; the frame is of spaces and hyphens where stdout is not known to take UTF-8.
    for line in box.splitlines()[1:]:
        row = line[2:].rstrip("│ ")
        if not row.strip("─╯-"):
            sections.append([])
        elif not row.startswith(" " * 5):
            sections[-1].append(row.strip())
    texts = [" ".join(rows) for rows in sections]
    return "; ".join(t for t in texts if t and not t.startswith(_ASIDES))


def _usage() -> str:
    lines = ["usage: crisalad COMMAND [--help] ...", "", "commands:"]
    lines += [f"  {name:<10}{kind.__doc__}" for name, (kind, _) in _COMMANDS.items()]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] in ("-h", "--help"):
        print(_usage(), file=sys.stdout if given else sys.stderr)
        return 0 if given else 2
    try:
        kind, run = choose("command", given[0], _COMMANDS)
        # Nested settings are annotated with an empty name, so their flags carry no prefix.
        options: dict[str, Any] = {}
        if kind is Train:
            kind = Annotated[kind, tyro.conf.AvoidSubcommands]
            options["default"] = Train(
                data=tyro.MISSING, out=tyro.MISSING, settings=_train_defaults(given[1:])
            )
        chosen = _parse(kind, given, options)
        platform.set_up()
        run(chosen)
    except (InputError, OSError) as error:  # the disk's: it is full, or what no check foresaw
        print("crisalad:", *str(error).splitlines(), file=sys.stderr)
        return 2
    except SystemExit:  # from tyro, after --help
        return 0
    except Stopped as stopped:
        print(f"crisalad: {stopped}", file=sys.stderr)
        return 128 + stopped.number
    except KeyboardInterrupt:
        print("crisalad: interrupted", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
