"""The faults that are planted."""

import pathlib

import pytest

SOURCE = '''"""A module of 1 line."""

def most(values: list[int], count: int = 3) -> list[int]:
    require(count >= 0, f"count: found {count}, expected 0 or more")
    if not values:
        raise ValueError("found none of 3")
    return sorted(values, reverse=True)[:count]
'''
EXPECTED = [
    (3, "3", "(4)"),
    (4, 'require(count >= 0, f"count: found {count}, expected 0 or more")', "pass"),
    (4, "count >= 0", "(count > 0)"),
    (4, "0", "(1)"),
    (5, "if not values:", "pass"),
    (5, "not values", "(values)"),
    (7, "sorted(values, reverse=True)[:count]", "(sorted(values, reverse=True)[:])"),
    (7, "sorted(values, reverse=True)", "(list(values))"),
    (7, "sorted(values, reverse=True)", "(sorted(values))"),
    (7, "True", "(False)"),
]


@pytest.fixture
def plant_faults(scripts):
    return scripts("plant_faults")


def test_every_fault_of_a_module(plant_faults):
    found = plant_faults.faults_of(SOURCE)
    each = [(fault.line, fault.before.splitlines()[0], fault.after) for fault in found]
    assert sorted(each) == sorted(EXPECTED)
    for fault in found:
        changed = SOURCE.encode()[: fault.start] + fault.after.encode()
        compile(changed + SOURCE.encode()[fault.end :], "changed", "exec")


def test_draws_are_of_different_lines_and_the_same_again(plant_faults):
    faults = plant_faults.faults_of(SOURCE)
    drawn = plant_faults.draw(faults, 3, "0")
    assert len({fault.line for fault in drawn}) == 3
    assert drawn == plant_faults.draw(faults, 3, "0")
    assert len(plant_faults.draw(faults, 9, "0")) == 4


@pytest.mark.parametrize(
    ("module", "tests"),
    [
        (
            "training/losses/pairwise.py",
            [f"training/losses/test_{name}.py" for name in ("distil", "losses", "divergence")],
        ),
        ("utils/checksums.py", ["utils/test_checksums.py"]),
    ],
)
def test_the_nearest_tests(plant_faults, module, tests):
    found = plant_faults.nearest_tests(pathlib.Path("crisalad_jax") / module)
    assert found == [f"tests/{name}" for name in tests]
