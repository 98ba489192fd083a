"""What a comparison's folder may be asked for after it began."""

import dataclasses
import pathlib

import pytest

from crisalad_jax.experiments.comparison import ComparisonConfig
from crisalad_jax.experiments.comparison.ledger import grown
from crisalad_jax.utils.errors import InputError

OUT = pathlib.Path("out")
ABLATION = ComparisonConfig(
    "ablate",
    ("crisalad",),
    ("town",),
    train="city",
    preset="tiny",
    seeds=2,
    rows=("slow: optimiser.learning_rate=1e-4",),
)
METHODS = ComparisonConfig("compare", ("salad", "crisalad"), ("town",), train="city", preset="tiny")


def test_it_grows_by_rows_seeds_and_sets_in_any_order():
    given = dataclasses.replace(
        ABLATION,
        names=("short", "step", "slow"),
        test=("village", "town"),
        rows=("short: epochs=2", *ABLATION.rows),
        seeds=3,
        reference="slow",
    )
    found = grown(ABLATION, given, OUT)
    assert found.names == ("crisalad", "slow", "short", "step")
    assert [row.name for row in found.rows] == ["slow", "short"]
    assert (found.test, found.seeds, found.reference) == (("town", "village"), 3, None)
    assert grown(found, ABLATION, OUT) is found
    assert grown(found, given, OUT) is found


def test_it_grows_by_methods_and_weights():
    given = dataclasses.replace(
        METHODS, names=("boq", "ours", "salad"), weights=("boq=b.safetensors", "ours=o.safetensors")
    )
    found = grown(METHODS, given, OUT)
    assert found.names == ("salad", "crisalad", "boq", "ours")
    assert found.weights == given.weights


def test_models_from_files_may_be_joined_by_what_is_trained():
    """Nothing there depends on the training set."""
    files = ComparisonConfig("compare", ("ours",), ("town",), weights=("ours=o",), preset="tiny")
    given = dataclasses.replace(files, names=("ours", "salad"), train="city", epochs=2)
    found = grown(files, given, OUT)
    assert (found.train, found.epochs) == ("city", 2)
    with pytest.raises(InputError, match=r"comparison: train: was city, is none; epochs: was 2, i"):
        grown(found, files, OUT)


def test_a_second_stage_may_join_with_its_number():
    given = dataclasses.replace(METHODS, names=("crisalad+patch-netvlad",), rerank=5)
    found = grown(METHODS, given, OUT)
    assert found.rerank == 5
    with pytest.raises(InputError, match="rerank: was 5, is 20"):
        grown(found, METHODS, OUT)


@pytest.mark.parametrize(
    ("existing", "changes", "words"),
    [
        (ABLATION, {"epochs": 2}, "epochs: was none, is 2"),
        (ABLATION, {"train": "village"}, "train: was city, is village"),
        (ABLATION, {"batch_size": 8}, "batch_size: was 16, is 8"),
        (ABLATION, {"image_size": (56, 56)}, r"image_size: was none, is \(56, 56\)"),
        (
            ABLATION,
            {"rows": ("slow: optimiser.learning_rate=1e-5, epochs=2",)},
            "row slow: optimiser.learning-rate: was 1e-4, is 1e-5; row slow: epochs: was not set, "
            "is 2",
        ),
        (ABLATION, {"rows": ("slow: recipe=salad, optimiser.learning_rate=1e-4",)},
         "row slow: recipe: was crisalad, is salad"),
        (METHODS, {"weights": ("salad=s",)}, "weights of salad: was trained here, is s"),
        (METHODS, {"kind": "ablate", "names": ("crisalad",)}, "kind: was compare, is ablate"),
    ],
)  # fmt: skip
def test_what_would_change_results_is_refused(existing, changes, words):
    with pytest.raises(InputError, match=f"out: holds another comparison: {words}; give the same"):
        grown(existing, dataclasses.replace(existing, **changes), OUT)
