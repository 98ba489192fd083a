"""Tables 2 and 3, and times that are taken in turns."""

import json
import time

import jax
import pytest

from crisalad_jax.experiments.comparison import (
    ABLATIONS,
    ComparisonConfig,
    adapter_costs,
    prepare,
    runner,
)
from crisalad_jax.experiments.comparison.costs import (
    Spread,
    adapter_calls,
    adapter_memory,
    race,
    ratios,
)
from crisalad_jax.nn.adapters import ADAPTERS
from crisalad_jax.training.recipes import from_scratch, recipe
from tests.cli.test_cli import succeeds
from tests.conftest import BATCH


def test_table_3_to_the_unit():
    """Parameters and MACs as printed, and by hand at 768 and 384 wide, 16 x 16 patches."""
    costs = {cost.adapter: cost for cost in adapter_costs({}, {})}
    linears = 2 * 768 * 384
    depthwise = 9 * 384 + 384 * 384
    branches = 384 * 192 + 2 * 384 * 24 + (9 + 25) * 24 * 96
    assert costs["depthwise"].paper_parameters == linears + depthwise + 2 * 384 == 741_504
    assert costs["multi-resolution"].paper_parameters == linears + branches + 384 + 768 == 761_472
    assert costs["depthwise"].paper_macs == linears + 256 * depthwise == 39_223_296
    assert costs["multi-resolution"].paper_macs == linears + 256 * branches == 44_236_800
    assert costs["mlp"].paper_macs == 2 * linears + 384 + 768 == 1_180_800
    # Convolution biases, and of batch norms weight, bias and the two statistics, on 432 channels.
    assert costs["multi-resolution"].parameters == 761_472 + 432 + 4 * 432
    assert costs["mlp"].parameters == linears + 384 + 768
    assert costs["depthwise"].macs == 257 * linears + 256 * depthwise
    # Adapters that the paper lacks, after its own: LoRA of rank 8, and ten prompts.
    side = ["side", "side-multi-resolution"]
    assert list(costs)[3:] == ["dynamic-power", "lora", "prompts", "serial-parallel", *side]
    assert costs["lora"].parameters == 8 * (768 + 3 * 768 + 2 * 768)
    assert (costs["prompts"].parameters, costs["prompts"].paper_macs) == (7680, None)


@pytest.mark.slow
@pytest.mark.filterwarnings("error:Explicitly requested dtype float64")
def test_adapters_are_measured_in_float32_in_the_64_bit_mode() -> None:
    calls = adapter_calls()
    assert {*calls} == {*ADAPTERS}
    with jax.enable_x64(True):
        few = {name: calls[name] for name in ("none", "mlp")}
        measured = race(few, rounds=1), adapter_memory(few)
    costs = {cost.adapter: cost for cost in adapter_costs(*measured)}
    # Of four images, more than one activation of 384 numbers a token.
    more = (costs["mlp"].memory - 1) * measured[1]["none"]
    assert 4 * 257 * 384 * 4 < more < 10 * 4 * 257 * 768 * 4
    assert costs["mlp"].time.least > 0
    assert costs["lora"].time is costs["lora"].memory is None


def test_rows_change_one_thing_each():
    """The paper's Table 2, at its own size with a backbone given."""
    base = recipe("b14", "crisalad")
    rows = {name: row.training("b14", from_nothing=False) for name, row in ABLATIONS.items()}
    assert rows["crisalad"] == base
    assert rows["lr-1e-4"] == recipe("b14", "crisalad-1e-4")
    assert rows["step"] == recipe("b14", "crisalad-step")
    for name in ("multi-resolution", "mlp"):
        assert rows[name].model.backbone.adapter.part_name == name
    assert (rows["no-adapter"].trainable, rows["no-encoder"].trainable) == ("head", "adapters,head")
    assert rows["no-encoder"].model.cross_image.part_name == "none"
    assert rows["no-encoder"].optimiser == base.optimiser
    assert rows["no-encoder-step"].optimiser == rows["step"].optimiser


def test_from_nothing_rates_are_in_the_papers_proportion():
    scratch = from_scratch(recipe("tiny", "crisalad"))
    rows = {name: row.training("tiny", from_nothing=True) for name, row in ABLATIONS.items()}
    assert rows["crisalad"] == scratch == recipe("tiny")
    rate = scratch.optimiser.learning_rate
    assert rows["lr-1e-4"].optimiser.learning_rate == pytest.approx(rate * 10 / 6, rel=1e-12)
    assert rows["step"].optimiser.schedule.part_name == "step"
    assert {row.trainable for row in rows.values()} == {"all"}


@pytest.mark.slow  # the costs are tested by themselves
@pytest.mark.usefixtures("quick")
def test_ablate(flags, capfd, tmp_path, monkeypatch):
    """The row of the whole model is trained as `compare` trains CriSALAD."""
    calls = dict.fromkeys(adapter_calls(), lambda: lambda: time.sleep(1e-4))
    monkeypatch.setattr(runner, "adapter_calls", lambda: calls)
    monkeypatch.setattr(runner, "adapter_memory", lambda names: dict.fromkeys(names, 1))
    out = tmp_path / "out"
    given = ("ablate", "--rows", "crisalad", "--seeds", 1, *flags[flags.index("--epochs") :])
    printed = succeeds(capfd, *given, "--preset", "tiny", "--out", out)
    assert "741,504" in printed
    (row,) = json.loads((out / "results.json").read_text())["rows"]
    settings = "adapter depthwise, cross-image encoder yes, learning rate 0.001, scheduler linear"
    assert row["labels"] == ["crisalad", settings]
    assert "761,472" in (out / "index.html").read_text()
    # Measured once: what is on the disk is what is shown again.
    monkeypatch.delattr(runner, "race")
    assert "741,504" in succeeds(capfd, *given, "--preset", "tiny", "--out", out)


def test_every_row_can_be_made(shared):
    settings = {"test": (str(shared / "town"),), "train": str(shared / "city"), "preset": "tiny"}
    # An adapter 16 wide has no branch of a quarter of a sixteenth: one row does not fit this model.
    names = tuple(ABLATIONS)
    prepared = prepare(ComparisonConfig("ablate", names, batch_size=BATCH, **settings))
    assert [variant.name for variant in prepared.variants] == list(names)


def test_races_are_run_in_turns():
    """Round by round; the first call of all compiles, the first of a turn warms up, three count."""
    order = []
    contenders = {name: lambda name=name: lambda: order.append(name) for name in "ab"}
    found = race(contenders, rounds=2)
    assert order == ["a", "b"] + (["a"] * 4 + ["b"] * 4) * 2
    assert {name: len(rounds) for name, rounds in found.items()} == {"a": 2, "b": 2}


def test_ratios_are_of_one_round():
    rounds = {"slow": [2.0, 40.0, 9.0], "fast": [1.0, 10.0, 3.0]}
    assert Spread.of(ratios(rounds, "slow", "fast")) == (3.0, 2.0, 4.0)
