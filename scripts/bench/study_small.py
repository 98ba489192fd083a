"""Measure the effect of model parts and of variations of the rendered world in short trainings.

    python scripts/bench/study_small.py --runs RUNS [--data SET...] [STUDY...]

Studies: transport, transport_more and encoder (a small ViT with SALAD), adapters (such a ViT,
trained on a plainer world and frozen), world (a small ResNet with Conv-AP, on worlds that leave out
one variation at a time) and distil (starter-1 with a quarter of its pixels, trained on place
labels, on the descriptors of starter-1, or on both, in the same number of steps). All train only on
rendered places, and are evaluated on other rendered places and on each SET, named by its folder.
Runs in RUNS are resumed. A run takes two to ten minutes on two cores.
"""

import collections
import dataclasses
import hashlib
import itertools
import json
import pathlib
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import scipy.stats
from study_transport import VARIANTS, WATCHED, with_transport
from tables import Study, Table, flags, leave, read_some

from crisalad_jax.checkpoints.load import load
from crisalad_jax.checkpoints.public import with_backbone_of
from crisalad_jax.config.io import read_config, to_plain
from crisalad_jax.data.augmentations.light import LightAugmentConfig
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.places import read_places
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.experiments.distil import distil
from crisalad_jax.nn.cross_image import CrossImage
from crisalad_jax.nn.model import Model, init_crisalad
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.synthetic import VARIATIONS, WorldConfig, write_world
from crisalad_jax.training.config import LossConfig, TrainConfig
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.loop import fit, run_keys
from crisalad_jax.training.losses.distil import DistilConfig
from crisalad_jax.training.recipes import recipe
from crisalad_jax.utils.files import write_json
from crisalad_jax.utils.progress import progress_bar

WORLD = WorldConfig(sceneries=("street", "corridor", "country"), hard=0.0)
"""The world of the tables in docs/small.md, from before rooms, shapes and hard stands."""
WORLD_BASE = pathlib.Path(__file__).parents[2] / "docs" / "small" / "world_base.json"
BATCH = {"places_per_batch": 24, "images_per_place": 2, "min_images": 2}
DUSTBINS = ("dustbin a token", "dustbin's mass learnt")
TRANSPORTS: dict[str, dict[str, Any]] = {
    **{label: VARIANTS[label] for label in ("published, k = 3", "converged, implicit", *DUSTBINS)},
    "column tau 0.9, k = 20": VARIANTS["column tau 0.9, k = 20"],
    "epsilon learnt": {"learn_epsilon": True},
    "softmax": VARIANTS["softmax"],
}
MORE_TRANSPORTS: dict[str, dict[str, Any]] = {
    **{
        label: VARIANTS[label]
        for label in (
            "published, k = 3",
            "partial, a quarter",
            "partial, share learnt",
            "capacities",
            "quadratic",
            "top 4",
            "Gaussian start, k = 3",
            "network start, k = 3",
        )
    },
    "annealing, k = 6": {"step": "annealing", "iterations": 6},
    "Nesterov, k = 10": {"step": "nesterov", "iterations": 10},
    "column tau learnt, k = 20": VARIANTS["column tau 0.9, k = 20"] | {"learn_tau": True},
}
ADAPTERS = ("depthwise", "multi-resolution", "mlp", "serial-parallel", "side", "lora", "prompts")


class Asked(NamedTuple):
    """A set to evaluate on, with a short name for its images and their correct answers."""

    data: Benchmark
    contents: str


class Arm(NamedTuple):
    """One row of a study: how to train, and on which world."""

    label: str
    config: TrainConfig
    world: WorldConfig
    start: "Arm | None" = None
    """The arm whose run with the same seed provides the initial backbone."""
    teacher: str | None = None
    """The model to distil, in a form that `load` accepts."""


def small_vit() -> TrainConfig:
    """Make the recipe of `tiny` with half its width, three blocks, 5 x 7 patches and no encoder."""
    start = recipe("tiny")
    backbone: Any = start.model.backbone
    model = dataclasses.replace(
        start.model,
        image_size=(70, 98),
        backbone=dataclasses.replace(backbone, dim=64, depth=3, heads=2),
        cross_image="none",
    )
    return dataclasses.replace(start, model=model, epochs=3, sampler="shuffled", **BATCH)


def with_encoder(config: TrainConfig) -> TrainConfig:
    """Add the encoder of `tiny` to a configuration."""
    encoder: CrossImage = recipe("tiny").model.cross_image
    model = dataclasses.replace(config.model, cross_image=encoder)
    return dataclasses.replace(config, model=model)


def small_resnet() -> TrainConfig:
    """Make a training of the packaged model with half its width and fewer pixels."""
    start = read_config(TrainConfig, WORLD_BASE)
    backbone: Any = start.model.backbone
    model = dataclasses.replace(
        start.model, image_size=(96, 96), backbone=dataclasses.replace(backbone, width=16)
    )
    return dataclasses.replace(start, model=model, epochs=4, **BATCH)


def transport() -> list[Arm]:
    """Replace the published transport with each of the others."""
    world = WORLD
    return [
        Arm(label, with_transport(small_vit(), fields), world)
        for label, fields in TRANSPORTS.items()
    ]


def transport_more() -> list[Arm]:
    """Replace the published transport with each of the further ones."""
    return [
        Arm(label, with_transport(small_vit(), fields), WORLD)
        for label, fields in MORE_TRANSPORTS.items()
    ]


def adapters() -> list[Arm]:
    """Train adapters on seasons, times and weather, over a frozen backbone that saw none."""
    world = WORLD

    def config(adapter: str, trainable: str) -> TrainConfig:
        scratch = small_vit()
        backbone: Any = dataclasses.replace(scratch.model.backbone, adapter=adapter)
        model = dataclasses.replace(scratch.model, backbone=backbone)
        return dataclasses.replace(scratch, model=model, trainable=trainable)

    plain = dataclasses.replace(world, varied=("stand",))
    start = Arm("plain world", config("none", "all"), plain)

    def arm(label: str, adapter: str, trainable: str) -> Arm:
        return Arm(label, config(adapter, trainable), world, start)

    return [
        arm("no adapter", "none", "head"),
        *(arm(name, name, "adapters,head") for name in ADAPTERS),
        arm("no adapter, all trained", "none", "all"),
    ]


def encoder() -> list[Arm]:
    """Train without and with the cross-image encoder."""
    without, world = small_vit(), WORLD
    return [Arm("without", without, world), Arm("with", with_encoder(without), world)]


def world() -> list[Arm]:
    """Train on the whole world, and on worlds that leave out one variation each."""
    whole, config = dataclasses.replace(WORLD, scenes=600, test_scenes=1), small_resnet()
    arms = [Arm("whole", config, whole)]
    for name in VARIATIONS:
        varied = tuple(one for one in VARIATIONS if one != name)
        arms.append(Arm(f"no {name}", config, dataclasses.replace(whole, varied=varied)))
    arms.append(Arm("no paint", config, dataclasses.replace(whole, repaint=0.0)))
    for name in WORLD.sceneries:
        kinds = tuple(one for one in WORLD.sceneries if one != name)
        arms.append(Arm(f"no {name}", config, dataclasses.replace(whole, sceneries=kinds)))
    camera: Any = config.augmentation
    light = {
        field.name: getattr(camera, field.name) for field in dataclasses.fields(LightAugmentConfig)
    }
    plain = dataclasses.replace(config, augmentation=LightAugmentConfig(**light))
    arms.append(Arm("no camera's faults", plain, whole))
    return arms


def distillation() -> list[Arm]:
    """Train on labels only, on the teacher only, and on both."""
    start = read_config(TrainConfig, WORLD_BASE)
    model = dataclasses.replace(start.model, image_size=(96, 128))
    config = dataclasses.replace(start, model=model, epochs=6, **BATCH)
    whole = dataclasses.replace(WORLD, scenes=600, test_scenes=1)
    arms = [Arm("labels", config, whole)]
    for label, weight in (("teacher", 0.0), ("teacher and labels", 1.0)):
        loss = LossConfig(kind=DistilConfig(labels=weight))
        arms.append(Arm(label, dataclasses.replace(config, loss=loss), whole, teacher="starter-1"))
    return arms


STUDIES = {
    "transport": transport,
    "transport_more": transport_more,
    "encoder": encoder,
    "adapters": adapters,
    "world": world,
    "distil": distillation,
}


def digest(value: Any) -> str:
    """Make a short name for a JSON value."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:12]


def named(value: Any) -> str:
    """Make a short name for a configuration, by which studies share runs and worlds."""
    return digest(to_plain(value))


def open_asked(path: pathlib.Path) -> Asked:
    data = open_benchmark(path)
    files = [[path.name for path in side] for side in (data.queries, data.database)]
    return Asked(data, digest([files, [list(map(int, each)) for each in data.ground_truth()]]))


def folder_of(arm: Arm, seed: int, runs: pathlib.Path) -> pathlib.Path:
    """Return the folder of an arm's training with a seed."""
    names = [named(dataclasses.replace(arm.config, seed=seed)), named(arm.world)]
    if arm.start is not None:
        names.append(folder_of(arm.start, seed, runs).name)
    if arm.teacher is not None:
        names.append(describer_of(load(arm.teacher)).digest[:12])
    return runs / "runs" / "-".join(names)


def trained(arm: Arm, seed: int, runs: pathlib.Path) -> Model:
    """Train an arm with a seed, or resume its run."""
    config = dataclasses.replace(arm.config, seed=seed)
    root = runs / "worlds" / named(arm.world)
    write_world(root, arm.world)
    folder = folder_of(arm, seed, runs)
    if arm.teacher is not None:
        teacher, quiet = load(arm.teacher), Reading(quiet=True)
        return Model(
            distil(config, teacher, None, folder, data=root / "train", reading=quiet).params,
            config.model,
        )
    places = read_places(root / "train", min_images=config.min_images)
    initial = None
    if arm.start is not None:
        trained(arm.start, seed, runs)
        file = folder_of(arm.start, seed, runs) / "last.safetensors"
        initial = with_backbone_of(
            init_crisalad(run_keys(seed)[0], config.model), config.model, file
        )
    params = fit(config, places, folder, initial=initial, quiet=True).params
    return Model(params, config.model)


def run(arm: Arm, seed: int, asked: Mapping[str, Asked], runs: pathlib.Path) -> dict[str, Any]:
    """Return recalls of a trained model by set and grouping, and its transport's statistics."""
    folder = folder_of(arm, seed, runs)
    result = folder / "recalls.json"
    found: dict[str, Any] = json.loads(result.read_text()) if result.exists() else {"contents": {}}
    there = found["contents"]
    left = {name: one for name, one in asked.items() if there.get(name) != one.contents}
    if not left:
        return found
    model = trained(arm, seed, runs)
    alone = not model.config.cross_image.attends
    groupings = ("single",) if alone else ("single", "shuffled", "sequential")
    for name, one in left.items():
        results = evaluate(model, one.data, groupings=groupings, reading=Reading(quiet=True))
        there[name] = one.contents
        found[name] = {
            grouping: {f"R@{k}": 100 * each.recalls[k] for k in (1, 5)}
            for grouping, each in zip(groupings, results, strict=True)
        }
    last = read_metrics(folder / "metrics.jsonl")[-1]
    found |= {name: last[name] for name in WATCHED if name in last}
    write_json(result, found)
    return found


def paired(values: Sequence[float], base: Sequence[float]) -> str:
    """Format the mean difference of runs of the same seeds, with its 95 % Student's t interval."""
    differences = [a - b for a, b in zip(values, base, strict=True)]
    mean = statistics.mean(differences)
    if len(differences) < 2:
        return f"{mean:+.1f}"
    error = statistics.stdev(differences) / len(differences) ** 0.5
    reach = float(scipy.stats.t.ppf(0.975, len(differences) - 1)) * error
    return f"{mean:+.1f} ({mean - reach:+.1f} to {mean + reach:+.1f})"


def study_of(name: str, results: Mapping[str, list[dict[str, Any]]], sets: Sequence[str]) -> Study:
    """Tabulate arms and groupings: recall, and its difference to the first arm."""
    first = next(iter(results.values()))
    watched = [key for key in WATCHED if key in first[0]]
    rows = []
    for label, runs in results.items():
        for grouping in runs[0][sets[0]]:
            cells = [label, grouping, str(len(runs))]
            is_base = runs is first and grouping == "single"
            for data, recall in itertools.product(sets, ("R@1", "R@5")):
                values = [one[data][grouping][recall] for one in runs]
                cells.append(f"{statistics.mean(values):.1f}")
                alone = [one[data]["single"][recall] for one in first]
                cells.append("" if is_base else paired(values, alone))
            cells += [f"{statistics.mean(one[key] for one in runs):.2f}" for key in watched]
            rows.append(tuple(cells))
    header = ["trained with", "images described", "seeds"]
    for data, recall in itertools.product(sets, ("R@1", "R@5")):
        header += [f"{data}, {recall}", "difference"]
    header += [WATCHED[key] for key in watched]
    caption = (
        "Mean recall in percent. A difference is to the first row, for runs with the same seeds, "
        "with its 95 % interval by Student's t over seeds; about one in twenty such intervals "
        "excludes 0 by chance."
    )
    return Study(Table(tuple(header), rows, caption, 2), {"study": name, "runs": results})


def main() -> None:
    parser = flags("Train and tabulate; see the module docstring.", "docs/small")
    parser.add_argument("--runs", type=pathlib.Path, required=True, help="folder for the trainings")
    parser.add_argument(
        "--data", type=pathlib.Path, nargs="*", default=[], help="further sets to evaluate on"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    arguments = read_some(parser, STUDIES)
    whole = arguments.runs / "worlds" / named(WORLD)
    write_world(whole, WORLD)
    asked = {"rendered": open_asked(whole / "test")}
    for path in arguments.data:
        if path.name in asked:
            parser.error(f"--data: found two sets named {path.name}, expected different names")
        asked[path.name] = open_asked(path)
    arms = {name: STUDIES[name]() for name in arguments.studies}
    results: dict[str, dict[str, list[dict[str, Any]]]] = collections.defaultdict(dict)
    total = sum(map(len, arms.values())) * len(arguments.seeds)
    with progress_bar("trainings", total, "runs", quiet=False) as bar:
        for seed in arguments.seeds:
            for name, those in arms.items():
                for arm in those:
                    found = run(arm, seed, asked, arguments.runs)
                    results[name].setdefault(arm.label, []).append(found)
                    bar.advance(1, note=f"{name}, {arm.label}, seed {seed}")
    for name, found in results.items():
        leave(name, study_of(name, found, list(asked)), arguments)


if __name__ == "__main__":
    main()
