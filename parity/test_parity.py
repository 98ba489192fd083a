"""The rows of `python -m parity` as tests: layers, models and training runs in float32.

Of bfloat16 and float64 a few are taken; all others, and the full size, are marked slow.
"""

import pytest

from parity.cases import CASES, RUNS, checks
from parity.cases.case import build, cancelling, random, split
from parity.compare import Row
from parity.full_size import SIZES, full_size_checks

SEED = 0
NAMES = [what.name for what in (*CASES, *RUNS)]
SLOW = {
    "Sinkhorn: 100 iterations, epsilon 1.0",
    "DINO-SALAD",  # a part of CriSALAD
    "training CriSALAD's adapters and head",  # quick in float64
    "training CriSALAD's last block and head",
    "training CricaVPR's adapters and head",
}
QUICK = {
    "float32": set(NAMES) - SLOW,
    "bfloat16": {"attention", "MLP", "block, no adapter"},
    "float64": {
        "pixels to numbers",
        "positions: not square",
        "SwiGLU",
        "Sinkhorn: 3 iterations, epsilon 0.1",
        "loss",
        "training CriSALAD's adapters and head",
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
        for name in NAMES
    ],
)
def test_parity(precision: str, name: str) -> None:
    rows = checks(precision, SEED)[name]()
    assert_passed(rows)
    whole = [case for case in CASES if case.name == name and case.forward == "descriptor"]
    for case in whole:  # one or none: every parameter of it has a gradient, and was compared
        names = dict(build(case.model, precision, random(name, SEED)).named_parameters())
        del names["backbone.mask_token"]
        parts = split({n: p.detach().float().numpy() for n, p in names.items()})
        row = next(row for row in rows if row.quantity == "gradients")
        # Rounding may leave exactly 0 of those that cancel. The 1 is the images.
        assert len(parts) + 1 - len(cancelling(parts)) <= row.arrays <= len(parts) + 1


def test_the_quick_ones_exist() -> None:
    for quick in QUICK.values():
        assert quick <= set(NAMES)


@pytest.mark.slow
@pytest.mark.parametrize("size", range(len(SIZES)))
def test_full_size(size: int) -> None:
    found = full_size_checks("float32", SEED)
    assert_passed(list(found.values())[size]())
