"""Run the rows of `python -m parity` as tests: layers, models and training runs in float32.

The tests include a few bfloat16 and float64 rows; the others, and the full size, are marked slow.
"""

from typing import Any

import numpy as np
import pytest
import torch

import parity.cases.case
from parity.cases import ANYLOC, CASES, RUNS, checks
from parity.cases.case import build, cancelling, random, split
from parity.compare import Arrays, Row, compare
from parity.full_size import SIZES, full_size_checks

SEED = 0
NAMES = [what.name for what in (*CASES, *RUNS)]
SLOW = {
    "Sinkhorn: 100 iterations, epsilon 1.0",
    "DINO-SALAD",  # a part of CriSALAD
    "NetVLAD's descriptor",  # the aggregators have separate rows
    "AnyLoc's descriptor",
    "training CriSALAD's adapters and head",  # faster in float64
    "training CriSALAD's last block and head",
    "training CricaVPR's adapters and head",
}
QUICK = {
    "float32": set(NAMES) - SLOW,
    "bfloat16": {"attention", "block, no adapter"},
    "float64": {
        "pixels to numbers",
        "Sinkhorn: 3 iterations, epsilon 0.1",
        "loss",
    },
}


def assert_passed(rows: list[Row]) -> None:
    missed = [
        f"{row.quantity}: {row.worst} {row.relative:.2e} > {row.tolerance:.1e}"
        for row in rows
        if not row.passed
    ]
    assert not missed


@pytest.mark.parametrize(
    ("precision", "name"),
    [
        pytest.param(precision, name, marks=() if name in quick else pytest.mark.slow)
        for precision, quick in QUICK.items()
        for name in checks(precision, SEED)
    ],
)
def test_parity(precision: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    covered: dict[str, set[str]] = {}

    def spy(case: str, quantity: str, precision: str, ours: Arrays, *rest: Any, **more: Any) -> Row:
        covered[quantity] = set(ours)
        return compare(case, quantity, precision, ours, *rest, **more)

    monkeypatch.setattr(parity.cases.case, "compare", spy)
    assert_passed(checks(precision, SEED)[name]())
    for case in CASES:
        if case.name == name and "gradients" in covered:
            drawn = {n: draw(random(name, SEED)) for n, draw in case.inputs.items()}
            reals = {n for n, x in drawn.items() if np.issubdtype(x.dtype, np.floating)}
            assert reals <= covered["gradients"]
            # The whole model has gradients, except for what comes after AnyLoc's facet.
            if case.forward == "descriptor" and case.model is not ANYLOC:
                names = dict(build(case.model, precision, random(name, SEED)).named_parameters())
                del names["backbone.mask_token"]
                parts = split({n: p.detach().float().numpy() for n, p in names.items()})
                # For gradients that cancel, rounding may leave exactly 0.
                dead = cancelling(parts).keys()
                assert covered["gradients"] - dead == (parts.keys() | reals) - dead


@pytest.mark.parametrize("seed", range(3))
def test_the_miner_takes_some_pairs_and_leaves_some(seed: int) -> None:
    case = next(case for case in CASES if case.name == "miner")
    rng = random(case.name, seed)
    inputs = {name: torch.from_numpy(draw(rng)) for name, draw in case.inputs.items()}
    model = build(case.model, "float32", random(case.name, seed))
    found = case.part.theirs(model, inputs, model.config)
    labels = inputs["labels"]
    same = labels[:, None] == labels
    assert (
        0 < found["positives"].sum() < same.sum() - len(labels)
    )  # an image is not its own positive
    assert 0 < found["negatives"].sum() < (~same).sum()


def test_the_quick_ones_exist() -> None:
    for quick in QUICK.values():
        assert quick <= set(NAMES)


@pytest.mark.slow
@pytest.mark.parametrize("size", range(len(SIZES)))
def test_full_size(size: int) -> None:
    found = full_size_checks("float32", SEED)
    assert_passed(list(found.values())[size]())
