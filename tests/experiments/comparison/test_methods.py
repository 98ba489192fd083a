"""What a comparison compares: methods, any recipe, any registered part, and custom rows."""

import dataclasses
import json

import pytest

from crisalad_jax.cli import ablate, main
from crisalad_jax.config.registry import REGISTRIES
from crisalad_jax.experiments.comparison import (
    METHODS,
    ComparisonConfig,
    compare,
    parse_row,
    plan,
    prepare,
)
from crisalad_jax.experiments.comparison.methods import method_of, method_training
from crisalad_jax.training.recipes import from_scratch, recipe
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests.cli.test_cli import fails
from tests.conftest import BATCH


def row_training(name):
    return method_training(method_of(name, "tiny").recipe, "tiny", from_nothing=True)


def test_what_names_stand_for():
    names = {name: name for name in METHODS}
    names |= {part: f"crisalad+{part}" for part in ("netvlad", "patch-netvlad")}
    for name, method in names.items():
        assert method_of(name, "tiny") is METHODS[method]
    for name, whole in (
        ("crisalad-1e-4", "crisalad-1e-4"),
        ("step:newton", "crisalad+step:newton"),
        ("triplet", "crisalad+triplet"),
        ("salad+newton", "salad+newton"),
    ):
        method = method_of(name, "tiny")
        assert (method.title, method.recipe, method.rerank) == (whole, whole, None)


def test_a_method_is_trained_as_its_recipe_says():
    for name in ("crisalad-1e-4", "crisalad+step:newton", "crisalad+gem", "salad+newton"):
        expected = recipe("tiny", name)
        assert method_training(name, "tiny", from_nothing=False) == expected
        assert method_training(name, "tiny", from_nothing=True) == from_scratch(expected)


def test_a_row_swaps_one_part():
    base = row_training("crisalad")
    newton = row_training("newton")
    assert newton.model.aggregator.sinkhorn.step.part_name == "newton"
    sinkhorn = base.model.aggregator.sinkhorn
    aggregator = dataclasses.replace(newton.model.aggregator, sinkhorn=sinkhorn)
    model = dataclasses.replace(newton.model, aggregator=aggregator)
    assert dataclasses.replace(newton, model=model) == base


@pytest.mark.parametrize("name", ["light", "rand-augment", "none"])
def test_an_augmentation_that_is_compared_stays(name):
    """From nothing there is another one than the recipe's, except where it is what is compared."""
    found = row_training(f"augmentation:{name}")
    assert found.augmentation.part_name == name
    assert found.augmentation == recipe("tiny", f"crisalad+augmentation:{name}").augmentation
    base = row_training("crisalad")
    assert dataclasses.replace(found, augmentation=base.augmentation) == base


@pytest.mark.parametrize("name", ["optax.lion", "schedule:cosine"])
def test_an_optimiser_or_schedule_that_is_compared_stays(name):
    """From nothing all else is that of `scratch`."""
    base, found = row_training("crisalad"), row_training(f"crisalad+{name}")
    assert found != base
    change = {"kind": name} if name == "optax.lion" else {"schedule": "cosine"}
    optimiser = dataclasses.replace(base.optimiser, **change)
    assert found == dataclasses.replace(base, optimiser=optimiser)


def test_variants_of_parts(settings):
    names = ("crisalad", "step:newton", "anyloc")
    prepared = prepare(ComparisonConfig(**settings | {"names": names}))
    assert [(variant.labels, variant.trains) for variant in prepared.variants] == [
        *((("CriSALAD",), True), (("crisalad+step:newton",), True), (("AnyLoc",), False))
    ]
    ablation = prepare(ComparisonConfig(**settings | {"kind": "ablate", "names": names[:2]}))
    assert ablation.variants[1].labels == ("step:newton", "crisalad+step:newton")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("--methods", "step:newtons"), "--methods: found 'step:newtons', expected one"),
        (("--methods", "kind:newton"), "kind of aggregator, adapter, cross_"),
        (("--reference", "salad"), "--reference: found salad, expected one of those compared, cri"),
    ],
)
def test_unknown_names_are_refused(flags, capfd, tmp_path, given, words):
    fails(capfd, *flags, *given, "--out", tmp_path / "out", words=(words,))
    assert not list(tmp_path.iterdir())


@pytest.fixture
def registries(monkeypatch):
    """Registries to add to."""
    for kind in ("aggregator", "loss"):
        for name in ("_parts", "_presets"):
            parts = dict(getattr(REGISTRIES[kind], name))
            monkeypatch.setattr(REGISTRIES[kind], name, parts)


PLUGIN = '''
from crisalad_jax import register_aggregator

@register_aggregator("average")
def average(features):
    """The mean of all patches."""
    return features.patches.mean(axis=0)
'''


@pytest.mark.usefixtures("quick", "registries")
def test_a_plug_ins_part_from_training_to_the_table(settings, tmp_path, monkeypatch):
    """In a folder of a safe name; another source behind its name is refused."""
    exec(compile(PLUGIN, "plugin.py", "exec"), {"__name__": "plugin"})
    name, out, lines = "aggregator:average", tmp_path / "out", []
    monkeypatch.setattr(plan, "source_digest", lambda part: "first")
    config = ComparisonConfig(**settings | {"names": (name,), "seeds": 1, "epochs": 1})
    summary = compare(config, out, say=lines.append, quiet=True)
    assert lines[0] == "1 runs to compare; what is trained starts from nothing"
    (row,) = summary.rows
    assert (row.name, row.labels, row.dimension) == (name, (f"crisalad+{name}",), 32)
    assert (out / "crisalad+aggregator-average" / "seed-0" / "run" / "last.safetensors").is_file()
    assert json.loads((out / "results.json").read_text())["rows"][0]["name"] == name
    assert (out / "index.html").is_file()
    monkeypatch.setattr(plan, "source_digest", lambda part: "second")
    with pytest.raises(InputError, match=r"plug-ins\.aggregator average: was first, is second"):
        compare(config, out, quiet=True)


@pytest.fixture
def ablation(settings):
    return settings | {"kind": "ablate", "batch_size": BATCH}


def test_a_row_is_a_recipe_with_flags():
    """In any spelling of a flag; quotes keep commas and spaces."""
    row = parse_row(
        """far: recipe=salad, --optimiser.clip_norm=2.5, image_size=56 56, cities="A, e" 'B'"""
    )
    assert (row.name, row.recipe) == ("far", "salad")
    assert row.flags == (
        ("optimiser.clip-norm", "2.5"),
        ("model.image-size", "56 56"),
        ("cities", """"A, e" 'B'"""),
    )
    assert row.words.startswith("recipe=salad, optimiser.clip-norm=2.5, model.image-size=56 56")
    assert row.training("tiny", from_nothing=True).cities == ("A, e", "B")


def test_flags_change_what_they_name_and_nothing_else():
    row = parse_row(
        "all: loss.kind=triplet, loss.kind.margin=0.3, optimiser.clip-norm=None, "
        "augmentation=none, trainable=head, model.cross-image=none"
    )
    found, base = row.training("tiny", from_nothing=True), recipe("tiny")
    assert (found.loss.kind.part_name, found.loss.kind.margin) == ("triplet", 0.3)
    assert found.model == dataclasses.replace(base.model, cross_image="none")
    assert found.optimiser == dataclasses.replace(base.optimiser, clip_norm=None)
    assert (found.augmentation.part_name, found.trainable) == ("none", "head")
    assert dataclasses.replace(found.loss, kind=base.loss.kind) == base.loss


SHAPE = "expected NAME: flag=value, flag=value, each flag once"
REFUSED = [
    *(
        (text, f"--row: found '{text}', {SHAPE}")
        for text in (
            *("epochs=2", "x: ,", "x: epochs", "x: epochs=2, epochs=3", "x: cities=a', b"),
        )
    ),
    ("x: epoch=2", r"--row x: --epoch: found no such flag; did you mean .*--epochs INT"),
    ("x: help=1", "--row x: --help: found no such flag"),
    ("x: epochs=0", "--row x: TrainConfig.epochs: found 0, expected a whole number of at least 1"),
    ("x: loss.kind=tripel", "--row x: loss: found 'tripel', expected one of circle"),
    ("x: seed=1", "--row x: found seed, expected another flag: it is the same for all rows"),
    ("x: recipe=salat", "--row x: recipe: found 'salat', expected one of"),
    ("a-b: epochs=2", "--rows: found crisalad, a-b, a/b, .* under names that differ in letters"),
]


@pytest.mark.parametrize(("text", "words"), REFUSED, ids=[text for text, _ in REFUSED])
def test_refused_in_one_line(ablation, text, words):
    rows = (text, "a/b: epochs=1")
    words = words.replace("'", "['\"]")  # of a text with an apostrophe Python quotes by the other
    with pytest.raises(InputError, match=words) as caught:
        prepare(ComparisonConfig(**ablation | {"rows": rows}))
    assert "\n" not in str(caught.value)


def test_a_row_of_a_recipe_that_mines_trains_on_places(ablation):
    rows = ("x: recipe=netvlad, epochs=2",)
    with pytest.warns(Note, match="--row x: recipe: found netvlad, whose own recipe mines tuples"):
        (variant,) = prepare(ComparisonConfig(**ablation | {"names": (), "rows": rows})).variants
    assert not variant.training.mines
    assert variant.model.aggregator.part_name == "netvlad"


def test_what_a_row_sets_stays_as_it_is(ablation):
    """Else a comparison fits epochs, batches and warm-up to the training set."""
    rows = (
        "base: recipe=crisalad",
        "longer: epochs=40",
        "fewer: places-per-batch=2, min-images=2, images-per-place=2",
        "warm: optimiser.warmup-steps=2",
    )
    config = ComparisonConfig(**ablation | {"names": (), "rows": rows})
    assert config.lines == ("base", "longer", "fewer", "warm")
    found = {variant.name: variant.training for variant in prepare(config).variants}
    base = found["base"]
    # Eight places of three images: a batch an epoch, of 3 epochs, too few to warm up for one.
    assert (base.epochs, base.places_per_batch, base.images_per_place) == (3, 8, 3)
    assert base.optimiser.warmup_steps == 0
    optimiser = dataclasses.replace(base.optimiser, warmup_steps=10)  # a quarter of 40 steps
    assert found["longer"] == dataclasses.replace(base, epochs=40, optimiser=optimiser)
    fewer = found["fewer"]
    assert (fewer.places_per_batch, fewer.images_per_place, fewer.epochs) == (2, 2, 3)
    assert fewer.optimiser.warmup_steps == 3  # a quarter of 3 epochs of four batches
    assert found["warm"].optimiser.warmup_steps == 2


def test_the_cities_of_a_row_are_its_training_set(ablation):
    config = ComparisonConfig(**ablation | {"names": (), "rows": ("half: cities=Brill",)})
    (variant,) = prepare(config).variants
    assert (variant.places.cities, len(variant.places.names)) == (("Brill",), 4)


def test_a_table_says_what_a_row_changes(ablation):
    rows = ("hot: optimiser.learning-rate=0.01",)
    names = ("crisalad", "no-encoder-step")
    config = ComparisonConfig(**ablation | {"names": names, "rows": rows})
    assert [variant.labels for variant in prepare(config).variants] == [
        (
            "crisalad",
            "adapter depthwise, cross-image encoder yes, learning rate 0.001, scheduler linear",
        ),
        ("no-encoder-step", "cross-image encoder no, scheduler step"),
        ("hot", "optimiser.learning-rate=0.01"),
    ]


def test_the_command_line_takes_several(flags, monkeypatch, tmp_path):
    """With --row the paper's rows are left out but for the first, unless --rows names them."""
    seen = []

    def run_comparison(flags, command, names, *, rows):
        seen.append((command, names, rows, flags.reference))

    monkeypatch.setattr(ablate, "run_comparison", run_comparison)
    given = ["ablate", *map(str, flags[flags.index("--epochs") :]), "--preset", "tiny"]
    given += ["--out", str(tmp_path / "out")]
    texts = ("a: epochs=2", "b: loss.miner=none")
    rows = ["--row", texts[0], "--row", texts[1], "--reference", "a"]
    for more, names in (([], ("crisalad",)), (["--rows", "crisalad,step"], ("crisalad", "step"))):
        assert main([*given, *rows, *more]) == 0
        assert seen.pop() == ("ablate", names, texts, "a")
