"""What the benchmarks reckon with: turns, ratios, memory, waiting. No time is asserted."""

import concurrent.futures
import copy
import dataclasses
import itertools
import json
import pathlib
import re
import sys
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.config.preprocessing import IMAGENET_DEVIATION, IMAGENET_MEAN
from crisalad_jax.data.augmentations.rand_augment import RandAugmentConfig
from crisalad_jax.data.images import read_image
from crisalad_jax.data.places import read_places
from crisalad_jax.nn.attention import dot_product_attention
from crisalad_jax.nn.costs import part_costs
from crisalad_jax.training.recipes import recipe
from parity.reference.model import Crisalad as TorchCrisalad


@pytest.fixture(scope="module")
def timing(scripts: Any) -> ModuleType:
    return scripts("timing")


def test_a_ratio_is_of_the_same_round(timing: ModuleType) -> None:
    """4 / 2, 9 / 3 and 8 / 8; the medians over all rounds would give 8 / 3."""
    found = timing.ratio(timing.Timed([4.0, 9.0, 8.0]), timing.Timed([2.0, 3.0, 8.0]))
    assert found == (2.0, 1.0, 3.0)
    assert timing.times(found) == "2.00 (1.00 to 3.00)"


def test_contenders_take_turns(timing: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock on which a call of one takes 1 s and of the other 3: five calls at least."""
    now, called = 0.0, []

    def call(name: str, seconds: float) -> None:
        nonlocal now
        now += seconds
        called.append(name)

    def sleep(seconds: float) -> None:
        nonlocal now
        now += seconds

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now)
    monkeypatch.setattr(timing.time, "sleep", sleep)
    found = timing.race({"a": lambda: call("a", 1), "b": lambda: call("b", 3)}, rounds=2, calls=5)
    assert found == {"a": timing.Timed([1e3, 1e3]), "b": timing.Timed([3e3, 3e3])}
    # One call that does not count, then five.
    assert [(name, len(list(turn))) for name, turn in itertools.groupby(called)] == [
        *(("a", 6), ("b", 6)),
        *(("a", 6), ("b", 6)),
    ]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there the allocator itself counts")
def test_torchs_memory_is_the_most_at_once(timing: ModuleType) -> None:
    """Two arrays of a million numbers at the same time, although three are made."""

    def call() -> torch.Tensor:
        first = torch.ones(1_000_000)
        second = first + 1
        del first
        return second * 2

    # And a few bytes for the numbers 1 and 2.
    assert 8_000_000 <= timing.torch_memory(call) < 8_000_100


def test_descriptors_that_differ_are_not_raced(scripts: Any) -> None:
    bench = scripts("bench_describe")

    def contender(name: str, found: Any) -> Any:
        return bench.Contender(name, lambda: found, lambda: 0)

    theirs, ours = torch.tensor([[0.6, 0.8]]), jnp.array([[0.6, 0.801]])
    bench.check([contender("torch", theirs), contender("ours", ours)], tolerance=2e-3)
    with pytest.raises(RuntimeError, match=r"ours: differs from torch by 1\.0e-03"):
        bench.check([contender("torch", theirs), contender("ours", ours)], tolerance=5e-4)


def raced(contender: str, *ms: float, batch: int = 8, **others: Any) -> dict[str, Any]:
    """What is kept of a contender whose rounds took so long."""
    found = {"model": "tiny at 98 x 98", "batch": batch, "dtype": "float32", "machine": "here"}
    found |= {"share of the machine": 0.5, "first call": 1.5, "memory": None}
    return found | {"contender": contender, "ms": list(ms)} | others


def test_ours_is_compared_with_the_fastest_of_the_others(scripts: Any) -> None:
    """By medians of 16, 8 and 10 ms; by single rounds torch would be it."""
    bench = scripts("bench_describe")
    race = [
        raced("OpenVINO", 7.0, 8.0, 9.0),
        raced("torch eager", 16.0, 16.0, 1.0),
        raced("ours", 10.0, 10.0, 10.0, memory=2_000_000),
    ]
    table = bench.speeds(race, "Speeds.")
    assert table.header[:3] == ("model", "images", "type")
    (row,) = table.rows
    assert dict(zip(table.header[3:], row[3:], strict=True)) == {
        "torch eager": "500 (500 to 8000)",
        "OpenVINO": "1000 (889 to 1143)",
        "ours": "800 (800 to 800)",
        "ours: speedup over the fastest other": "0.80 (0.70 to 0.90)",
        "ours: share of the machine": "50 %",
    }
    (row,) = bench.costs(race, "Costs.").rows
    assert row[3:] == ("1.5 s", "1.5 s", "1.5 s, 2.0 MB")


def test_races_of_this_machine_stay_unless_they_are_run_anew(scripts: Any) -> None:
    bench = scripts("bench_describe")
    again, other = raced("ours", 1.0), raced("ours", 1.0, batch=1)
    elsewhere = raced("ours", 1.0, batch=2, machine="there")
    new = [raced("ours", 2.0), raced("OpenVINO", 2.0)]
    assert bench.kept([again, other, elsewhere, {"contender": "ours"}], new) == [other]
    # By model as they are listed, type, size of the batch.
    values = [
        raced("ours", 1.0, dtype="bfloat16", batch=1),
        *(raced("ours", 1.0), raced("ours", 1.0, batch=1)),
    ]
    found = [(value["dtype"], value["batch"]) for value in bench.in_order(values)]
    assert found == [("float32", 1), ("float32", 8), ("bfloat16", 1)]


@pytest.mark.parametrize("dtype", ["float32", pytest.param("bfloat16", marks=pytest.mark.slow)])
def test_what_users_write_computes_what_the_reference_does(scripts: Any, dtype: str) -> None:
    """Attention, biases and narrow weights; a mask too."""
    usual = scripts("usual")
    config = dataclasses.replace(recipe("tiny").model, compute_dtype=dtype)
    torch.manual_seed(0)
    reference = TorchCrisalad(config).eval()
    written = usual.as_users_write_it(copy.deepcopy(reference))
    images, mask = torch.randn(3, 3, 98, 98), torch.eye(3, dtype=torch.bool)
    with torch.inference_mode():
        for model in (written, usual.narrowed(copy.deepcopy(written))):
            for args in ((images,), (images, mask)):
                off = (model(*args) - reference(*args)).abs().max()
                # Of unit vectors, that are rounded elsewhere: float32's 24 bits, bfloat16's 8.
                assert off < (1e-6 if dtype == "float32" else 2e-2)
        assert usual.widened(written)(images).dtype == torch.float32
    kinds = {type(layer).__name__ for layer in written.modules()}
    assert {"_Attention", "_MultiheadAttention", "_Linear", "_Conv2d"} <= kinds
    assert not {"Attention", "MultiheadAttention", "Linear", "Conv2d"} & kinds


def test_engines_read_what_torch_writes(scripts: Any) -> None:
    """A layer's product, by each that is installed."""
    engines = scripts("engines")
    found = engines.readers("float32")
    if not found:
        pytest.skip("the bench extra is not installed")
    torch.manual_seed(0)
    layer, inputs = torch.nn.Linear(5, 3), torch.randn(4, 5)
    expected = layer(inputs).detach().numpy()
    with engines.onnx_file(layer, inputs) as path:
        for read in found.values():
            # Sums of five numbers, in another order.
            np.testing.assert_allclose(read(path, inputs.numpy())(), expected, atol=1e-6)
    assert "ONNX Runtime" not in engines.readers("bfloat16")


def test_only_what_no_program_hides_is_waited_for(
    scripts: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = scripts("bench_extract")
    watch = bench.Watch()
    # Asked and answered: before any program, with one that ended at 5, with one still running.
    clock = iter([0.0, 2.0, 4.0, 9.0, 9.0, 20.0])
    monkeypatch.setattr(bench.time, "perf_counter", lambda: next(clock))
    batches = watch.each(["first", "second"])
    assert next(batches) == "first"
    assert watch.waited == 2
    watch._ended = concurrent.futures.Future()
    watch._ended.set_result(5.0)
    assert next(batches) == "second"
    assert watch.waited == 2 + (9 - 5)
    watch._ended = concurrent.futures.Future()
    assert next(batches, None) is None
    assert watch.waited == 6


def test_operations_of_a_step_are_those_of_what_trains(scripts: Any) -> None:
    """Of all three times the forward's; of adapters and head little more than twice."""
    bench, tiny, paper = scripts("bench_train"), recipe("tiny"), recipe("b14")
    assert (tiny.trainable, paper.trainable) == ("all", "adapters,head")

    def forward(recipe: Any) -> float:
        return 2 * 8 * sum(cost.macs for cost in part_costs(recipe.model, images=8))

    assert bench.operations(tiny, 8) == 3 * forward(tiny)
    # The head's are a twentieth of all, the embedding's less.
    assert 1.9 * forward(paper) < bench.operations(paper, 8) < 2.2 * forward(paper)


PROGRAM = """
  %dot.7 = f32[9]{0} dot(%a, %b), metadata={op_name="jit(f)/...hid,...hjd->...hij/dot_general"}
  ROOT %dot.8 = f32[9]{0} dot(%a, %b), metadata={op_name="jit(f)/jvp()/dot_general"}
  %copy_bitcast_fusion.1 = f32[9]{0} fusion(%a), metadata={op_name="jit(f)/transpose"}
  %bitcast_dynamic-update-slice_fusion = f32[9]{0} fusion(%a, %b)
  %add_bitcast_fusion = f32[9]{0} fusion(%a), metadata={op_name="jit(f)/add"}
  %wrapped_broadcast.2 = f32[9]{0} fusion(), metadata={op_name="jit(f)/broadcast_in_dim"}
  %broadcast_add_fusion.2 = f32[9]{0} fusion(%a), metadata={op_name="jit(f)/add"}
  %all-reduce.3 = f32[9]{0} all-reduce(%a), metadata={op_name="jit(f)/dot_general"}
  %copy_multiply_fusion.1 = f32[9]{0} fusion(%a), metadata={op_name="jit(f)/mul"}
  %cond.5 = f32[9]{0} conditional(%a), metadata={op_name="jit(f)/cond"}
  %while.4 = f32[9]{0} while(%a), metadata={op_name="jit(f)/while"}
"""


def test_operations_of_a_trace_are_told_apart(scripts: Any) -> None:
    """Each once, the n-th for 2^n microseconds; what is not of the program, or holds it, never."""
    bench = scripts("bench_profile")
    names = (
        *("dot.7", "dot.8", "copy_bitcast_fusion.1", "bitcast_dynamic-update-slice_fusion"),
        *("add_bitcast_fusion", "wrapped_broadcast.2", "broadcast_add_fusion.2", "all-reduce.3"),
        *("while.4", "another", "copy_multiply_fusion.1", "cond.5"),
    )
    events = [{"ph": "X", "name": name, "dur": 2**n} for n, name in enumerate(names)]
    found = bench.milliseconds([*events, {"ph": "M", "name": "dot.7"}, {}], PROGRAM)
    assert found == {
        "between devices": 0.128,
        "attention's products": 0.001,
        "other products": 0.002,
        "constants written": 0.032,
        "copies": 0.004 + 0.008,
        "numbers one by one, sums": 0.016 + 0.064 + 1.024,
    }


def test_attentions_products_are_told_by_the_compiled_program(scripts: Any) -> None:
    bench = scripts("bench_profile")
    x = jnp.ones((2, 9, 2, 8))
    gradient = jax.grad(lambda q, k, v: dot_product_attention(q, k, v).sum(), argnums=(0, 1, 2))
    program = jax.jit(gradient).lower(x, x, x).compile().as_text() or ""
    products = {
        name: bench.kind(name, made_of)
        for name, made_of in bench.INSTRUCTION.findall(program)
        if re.match(r"dot", name)
    }
    # The scores again, and the gradients of weights, values, queries and keys.
    assert list(products.values()) == ["attention's products"] * 5


def test_growth_is_over_the_least_of_what_grows(scripts: Any) -> None:
    bench = scripts("bench_scale")

    def point(grows: str, value: int, operations: int, ours: float, theirs: float) -> Any:
        found = {"grows": grows, "value": value, "operations": operations, "faster": (1.0,) * 3}
        return found | {"ours": [ours], "theirs": [theirs], "memory": 10**6, "their memory": 10**7}

    values = [point("images", 1, 8, 4.0, 6.0), point("images", 4, 8, 3.0, 3.0)]
    values += [point("clusters", 16, 10, 2.0, 2.0), point("clusters", 64, 20, 5.0, 3.0)]
    table = bench.table(bench.grown(values), "Growth.")
    faster = "1.00 (1.00 to 1.00)"
    assert table.rows == [
        ("images", "1", "1.00", "1.00", "1.00", faster, "1.0", "10.0"),
        ("images", "4", "1.00", "0.75", "0.50", faster, "1.0", "10.0"),
        ("clusters", "16", "1.00", "1.00", "1.00", faster, "1.0", "10.0"),
        ("clusters", "64", "2.00", "2.50", "1.50", faster, "1.0", "10.0"),
    ]


def test_a_tree_of_the_size_of_gsv_cities_is_one(scripts: Any, tmp_path: pathlib.Path) -> None:
    scripts("bench_index").write_tree(tmp_path, cities=2, places=3, images=26, size=16)
    places = read_places(tmp_path)
    assert places.cities == ("City00", "City01")
    assert places.image_counts.tolist() == [5, 5, 4, 4, 4, 4]
    assert read_image(places.path(0)).shape == (16, 16, 3)


def test_both_loaders_give_the_same_images(
    scripts: Any, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where nothing is drawn: Pillow and OpenCV differ by a level or two of 256."""
    bench = scripts("bench_loader")
    monkeypatch.setattr(bench, "AUGMENT", RandAugmentConfig(operations=0))
    bench.write_tree(tmp_path, 8, (60, 80))
    places = read_places(tmp_path)
    dataset = bench.Photographs(places)
    (ours,) = bench.our_batches(places, 8)
    mean, deviation = (np.array(x).reshape(3, 1, 1) for x in (IMAGENET_MEAN, IMAGENET_DEVIATION))
    for image, label, index in zip(ours.images, ours.labels, ours.indices, strict=True):
        values, place = dataset[int(index)]
        assert place == label == index // 4
        pixels = 255 * (values.numpy() * deviation + mean)
        np.testing.assert_allclose(pixels.transpose(1, 2, 0), image, atol=3)


@pytest.mark.slow
def test_the_search_is_measured(
    scripts: Any, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All three studies at a small size: what is found, not how fast."""
    flags = (
        f"bench_search --out {tmp_path} --rows 2000 --lengths 32 --queries 20 --rounds 1 "
        f"--memory-rows 1000 4000 --memory-length 64 --folder {tmp_path} "
        "--approximate-rows 10000 --approximate-length 32"
    )
    monkeypatch.setattr(sys, "argv", flags.split())
    scripts("bench_search").main()
    assert not list(tmp_path.glob("search-*"))  # the databases are gone
    speed, memory, approximate = (
        json.loads((tmp_path / f"{name}.json").read_text())
        for name in ("bench_search", "search_memory", "search_approximate")
    )
    # Two distances that FAISS rounds to one may stand the other way round.
    assert all(value["alike"] > 0.99 for value in speed)
    assert [value["rows"] for value in memory] == [1000, 4000]
    assert all(value["memory"] > 2e7 for value in memory)  # an interpreter, at least
    recalls = {value["contender"]: value["recall"] for value in approximate}
    assert recalls["exact"] == 1
    assert recalls["hnsw, default"] > 0.95
    assert recalls["ivf-rabitq, default"] > 0.3
    assert all(value["among"] > 0.9 for value in approximate if "default" in value["contender"])


@pytest.mark.parametrize(
    ("name", "flags", "words"),
    [
        ("bench_describe", "--sizes 98", "argument --sizes: found '98', expected a size such as"),
        ("bench_describe", "--sizes 99x99", "image size: found 99 x 99, expected sides that are"),
        ("bench_extract", "--images none", "argument --images: found 'none'"),
        ("bench_locate", "--cores 0", "argument --cores: found '0', expected a whole number"),
        ("bench_profile", "--out pyproject.toml", "expected a folder that can be written to"),
        ("bench_index", "--images 10", "found 10 images of 46000 places, expected at least 48"),
        ("bench_loader", "--batch 6", "found 960 images in batches of 6, expected a multiple of"),
        ("bench_memory", "--images 190", "found 190 images, expected a multiple of 4"),
        ("bench_overlap", "--steps 4", "found 4 steps of 48 images, expected more than 4 steps"),
        ("bench_search", "nothing", "found nothing, expected some of bench_search, search_memory"),
        ("bench_search", "--memory-rows 9000000000", "GB free, expected 304128.0 GB"),
        ("bench_sinkhorn", "--calls -1", "argument --calls: found '-1'"),
    ],
)
def test_what_cannot_be_is_said_before_the_work(scripts, monkeypatch, capsys, name, flags, words):
    bench = scripts(name)
    monkeypatch.setattr(sys, "argv", [name, *flags.split()])
    with pytest.raises(SystemExit) as stop:
        bench.main()
    assert stop.value.code == 2
    assert words in capsys.readouterr().err
