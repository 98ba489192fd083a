"""Rows of an ablation of one's own, by the flags of `train`."""

import dataclasses

import pytest

from crisalad_jax.cli import ablate, main
from crisalad_jax.config.registry import REGISTRIES
from crisalad_jax.experiments.comparison import AblationRow, ComparisonConfig, parse_row, prepare
from crisalad_jax.experiments.comparison.plan import labels_of
from crisalad_jax.experiments.comparison.rows import as_row
from crisalad_jax.training.recipes import recipe
from crisalad_jax.utils.errors import InputError
from tests.cli.test_cli import fails
from tests.conftest import BATCH


@pytest.fixture
def ablation(settings):
    return settings | {"kind": "ablate", "batch_size": BATCH}


def test_text_and_values_are_the_same_row():
    text = "mine: recipe=salad, --optimiser.learning_rate=1e-05, image_size=56 56, loss.miner=none"
    values = {"optimiser.learning_rate": 1e-5, "image_size": (56, 56), "loss.miner": "none"}
    expected = AblationRow(
        "mine",
        "salad",
        ("optimiser.learning-rate=1e-05", "model.image-size=56 56", "loss.miner=none"),
    )
    assert parse_row(text) == as_row(("mine", {"recipe": "salad", **values})) == expected
    assert expected.words == f"recipe=salad, {', '.join(expected.changes)}"


def test_quotes_keep_commas_and_spaces():
    row = parse_row("""far: cities="Aston, east" 'Brill', epochs=2""")
    assert row.changes == ("""cities="Aston, east" 'Brill'""", "epochs=2")
    config = row.training("tiny", from_nothing=True)
    assert config.cities == ("Aston, east", "Brill")
    assert as_row(("far", {"cities": ("Aston, east", "Brill")})).training(
        "tiny", from_nothing=True
    ).cities == ("Aston, east", "Brill")


def test_flags_change_what_they_name_and_nothing_else():
    row = parse_row(
        "all: loss.kind=triplet, loss.kind.margin=0.3, optimiser.clip-norm=None, "
        "augmentation=none, trainable=head, model.cross-image.layers=0"
    )
    found, base = row.training("tiny", from_nothing=True), recipe("tiny")
    assert (found.loss.kind.part_name, found.loss.kind.margin) == ("triplet", 0.3)
    assert found.model == dataclasses.replace(
        base.model, cross_image=dataclasses.replace(base.model.cross_image, layers=0)
    )
    assert found.optimiser == dataclasses.replace(base.optimiser, clip_norm=None)
    assert (found.augmentation.part_name, found.trainable) == ("none", "head")
    assert dataclasses.replace(found.loss, kind=base.loss.kind) == base.loss


REFUSED = [
    ("epochs=2", "--row: found 'epochs=2', expected NAME: flag=value, flag=value"),
    ("a b", "--row: found 'a b', expected NAME"),
    ("x:", "--row x: found no change, expected NAME: flag=value"),
    ("x: ,", "--row x: found no change, expected NAME: flag=value"),
    ("x: epochs", "--row x: found 'epochs', expected flag=value"),
    ("x: epochs=", "--row x: found 'epochs=', expected flag=value"),
    ("x: recipe=", "--row x: found 'recipe=', expected flag=value"),
    ("x: epochs=2, epochs=3", "--row x: found epochs twice, expected it once"),
    ("x: epochs=two", "--row x: .*--epochs.*'two'"),
    ("x: epoch=2", r"--row x: --epoch: found no such flag; did you mean .*--epochs INT"),
    ("x: help=1", "--row x: --help: found no such flag"),
    ("x: epochs=0", "--row x: TrainConfig.epochs: found 0, expected more than 0"),
    ("x: epochs=99999999999999", r"--row x: epochs: found 99999999999999, expected a number of at"),
    ("x: loss.kind=tripel", "--row x: loss: found 'tripel', expected one of circle"),
    ("x: seed=1", "--row x: seed: found 1, expected the comparison's --seeds"),
    ("x: patience=1", "--row x: patience: found 1, expected none: a comparison validates nothing"),
    ("x: cities='a", "--row x: cities: found 'a, expected closed quotes"),
    ("x: recipe=netvlad", r"--row x: found recipe netvlad.*such as crisalad\+netvlad"),
    ("x: recipe=salat", "--row x: recipe: found 'salat', expected one of"),
    ("step: epochs=2", "--row: found the name step twice, or as one of the paper's rows"),
]


@pytest.mark.parametrize(("text", "words"), REFUSED, ids=[text for text, _ in REFUSED])
def test_refused_in_one_line(ablation, text, words):
    with pytest.raises(InputError, match=words) as caught:
        ComparisonConfig(**ablation | {"rows": (text,)})
    assert "\n" not in str(caught.value)


def test_rows_of_one_folder_are_refused_with_their_flag(ablation):
    rows = ("a/b: epochs=1", "a-b: epochs=2")
    words = "--row: found a/b and a-b, whose results would both be in the folder a-b, expected"
    with pytest.raises(InputError, match=words):
        ComparisonConfig(**ablation | {"rows": rows})


def test_a_row_is_parsed_once(ablation, monkeypatch):
    """Its parser takes half a second, and a comparison asks for its configuration several times."""
    from crisalad_jax.experiments.comparison import rows as module

    module._changed.cache_clear()
    asked, parse = [], module.parse_changes
    monkeypatch.setattr(module, "parse_changes", lambda *a: asked.append(a) or parse(*a))
    config = ComparisonConfig(**ablation | {"rows": ("once: epochs=2",)})
    dataclasses.replace(config, seeds=2)
    assert len(asked) == 1


def test_what_a_row_sets_stays_as_it_is(ablation):
    """Else a comparison fits epochs, batches and warm-up to the training set."""
    rows = (
        ("base", {}),
        "longer: epochs=40",
        "fewer: places-per-batch=2, min-images=2, images-per-place=2",
        "warm: optimiser.warmup-steps=2",
    )
    config = ComparisonConfig(**ablation | {"names": (), "rows": rows})
    assert config.names == ("base", "longer", "fewer", "warm")
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
    assert (variant.places.cities, len(variant.places.place_id)) == (("Brill",), 4)


def test_a_table_says_what_a_row_changes(ablation):
    rows = ("hot: optimiser.learning-rate=0.01",)
    names = ("crisalad", "no-encoder-step")
    config = ComparisonConfig(**ablation | {"names": names, "rows": rows})
    assert labels_of(config) == ("row", "changed")
    assert [variant.labels for variant in prepare(config).variants] == [
        ("crisalad", ""),
        ("no-encoder-step", "cross-image encoder no, scheduler step"),
        ("hot", "optimiser.learning-rate=0.01"),
    ]


def test_a_plug_ins_loss_and_its_settings(ablation, monkeypatch):
    registry = REGISTRIES["loss"]
    for name in ("_parts", "_presets"):
        monkeypatch.setattr(registry, name, dict(getattr(registry, name)))
    source = """
import dataclasses, crisalad_jax as cj
@cj.register_loss("mine")
@dataclasses.dataclass(frozen=True)
class Mine(cj.Loss):
    scale: float = 1.0
    def apply(self, params, batch):
        return cj.LossValue(self.scale * batch.distances.sum())
"""
    exec(compile(source, "mine.py", "exec"), {"__name__": "mine"})
    row = parse_row("mine: loss.kind=mine, loss.kind.scale=2")
    assert row.training("tiny", from_nothing=True).loss.kind.scale == 2


def test_the_command_line_takes_several(flags, monkeypatch, tmp_path):
    """With --row the paper's rows are left out but for the first, unless --rows names them."""
    seen = []
    monkeypatch.setattr(ablate, "run_comparison", lambda config, arguments: seen.append(config))
    given = ["ablate", *map(str, flags[flags.index("--epochs") :]), "--preset", "tiny"]
    given += ["--out", str(tmp_path / "out")]
    rows = ["--row", "a: epochs=2", "--row", "b: loss.miner=none", "--reference", "a"]
    assert main([*given, *rows]) == 0
    assert main([*given, *rows, "--rows", "crisalad,step"]) == 0
    assert [config.names for config in seen] == [
        ("crisalad", "a", "b"),
        ("crisalad", "step", "a", "b"),
    ]
    assert seen[0].rows == (parse_row("a: epochs=2"), parse_row("b: loss.miner=none"))
    assert seen[0].reference == "a"


def test_an_unknown_reference(flags, capfd, tmp_path):
    words = ("--reference: found salad, expected one of those compared, crisalad",)
    fails(capfd, *flags, "--reference", "salad", "--out", tmp_path / "out", words=words)
    assert not list(tmp_path.iterdir())
