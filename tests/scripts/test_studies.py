"""The transport's studies against numpy at small size, and its page, run as written.

`plan_of` is the published algorithm by its scaling form in float64: exponentials of scores up to
about 40 in size are far from overflow there.
"""

import contextlib
import io
import itertools
import json
import pathlib
import re
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
import scipy.optimize
import scipy.special

from crisalad_jax.sinkhorn import STEPS, SinkhornConfig

ROOT = pathlib.Path(__file__).parents[2]
PAGE = ROOT / "docs" / "sinkhorn.md"
STUDIES = ROOT / "docs" / "sinkhorn-studies.md"
IMAGES, PATCHES, CLUSTERS = 3, 24, 5
CASES = list(itertools.product(("iid", "lowrank"), (1.0, 3.0, 10.0)))


@contextlib.contextmanager
def own_steps() -> Iterator[None]:
    """What is registered in this block ends with it."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("_parts", "_presets"):
            patch.setattr(STEPS, name, dict(getattr(STEPS, name)))
        yield


@pytest.fixture(scope="module")
def study(scripts: Any) -> Iterator[ModuleType]:
    with own_steps():
        yield scripts("study_sinkhorn")


def size(study: ModuleType, **fields: int) -> Any:
    small = {"images": IMAGES, "patches": PATCHES, "clusters": CLUSTERS, "limit": 400}
    return study.Size(**small | fields)


def plan_of(scores: np.ndarray, iterations: int, share: float | None = None) -> np.ndarray:
    """(patches, clusters) to (patches, clusters + 1), the dustbin's mass as published or so."""
    patches, clusters = scores.shape
    kernel = np.exp(np.append(scores, np.zeros((patches, 1)), axis=1))
    bin_share = (patches - clusters) / patches if share is None else share
    nu = patches * np.append(np.full(clusters, (1 - bin_share) / clusters), bin_share)
    u = np.ones(patches)
    for _ in range(iterations):
        v = nu / (kernel.T @ u)
        u = 1 / (kernel @ v)
    return u[:, None] * kernel * v


def slopes(plan: Any, at: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Central differences of the weighted sum of the clusters' part of the plan."""
    out = np.empty(at.size)
    for i, one in enumerate(np.eye(at.size).reshape(-1, *at.shape)):
        ends = [(weights * plan(at + sign * 1e-5 * one)[:, :-1]).sum() for sign in (1, -1)]
        out[i] = (ends[0] - ends[1]) / 2e-5
    return out


def run(study: ModuleType, name: str, **fields: int) -> Any:
    with jax.enable_x64(True):
        return study.STUDIES[name](size(study, **fields))


def scores_of(study: ModuleType, kind: str, std: float, **fields: int) -> np.ndarray:
    return study.scores_of(kind, std, size(study, **fields))


def test_scores_have_their_scale_and_rank(study: ModuleType) -> None:
    for kind, std in CASES:
        scores = scores_of(study, kind, std, images=8, patches=64, clusters=32)
        np.testing.assert_allclose(scores.std(), std, rtol=0.02)  # 16,384 independent ones
    # Four of the products, and one of the bias.
    assert np.linalg.matrix_rank(scores[0]) == 5


@pytest.mark.slow
def test_errors_and_masses_are_those_of_the_scaling_form(study: ModuleType) -> None:
    errors, masses = run(study, "error").values, run(study, "mass").values
    for (kind, std), mass in zip(CASES, masses, strict=True):
        plans = [plan_of(one, 3) for one in scores_of(study, kind, std)]
        found = np.array([plan.sum(axis=0) for plan in plans])
        relative = np.abs(found / np.array([1] * CLUSTERS + [PATCHES - CLUSTERS]) - 1).max(axis=1)
        (error,) = (v for v in errors if (v["kind"], v["std"], v["k"]) == (kind, std, 3))
        # Both are float64; errors are differences of numbers near 1.
        np.testing.assert_allclose(
            [error["median"], error["largest"]], [np.median(relative), relative.max()], atol=1e-12
        )
        clusters = found[:, :-1]
        np.testing.assert_allclose(
            [mass["smallest"], mass["largest"], mass["mean worst error"]],
            [clusters.min(), clusters.max(), np.abs(clusters - 1).max(axis=1).mean()],
            atol=1e-12,
        )


@pytest.mark.slow
def test_gradients_are_those_of_central_differences(study: ModuleType) -> None:
    values = run(study, "gradient", images=1).values
    weights = np.random.default_rng(1).standard_normal((1, PATCHES, CLUSTERS))[0]
    scores = scores_of(study, "lowrank", 3.0, images=1)[0]
    # 400: the marginal error is then rounding, which is asserted.
    assert np.abs(plan_of(scores, 400)[:, :-1].sum(axis=0) - 1).max() < 1e-12
    three, exact = (slopes(lambda at, k=k: plan_of(at, k), scores, weights) for k in (3, 400))
    (found,) = (v for v in values if (v["kind"], v["std"], v["k"]) == ("lowrank", 3.0, 3))
    relative = np.linalg.norm(three - exact) / np.linalg.norm(exact)
    cosine = three @ exact / np.linalg.norm(three) / np.linalg.norm(exact)
    # What differences over 2e-5 leave.
    np.testing.assert_allclose([found["relative"], found["cosine"]], [relative, cosine], atol=1e-7)


def iterations_to(tolerance: float, scores: np.ndarray, limit: int) -> int:
    """Of the plain iteration, until no potential changes more; one more than the limit.

    Changes are centred by masses."""
    kernel = np.append(scores, np.zeros((PATCHES, 1)), axis=1)
    log_nu = np.log(np.array([1.0] * CLUSTERS + [PATCHES - CLUSTERS]))
    row, column = np.zeros(PATCHES), np.zeros(CLUSTERS + 1)
    for count in range(1, limit + 1):
        new_column = log_nu - np.logaddexp.reduce(kernel + row[:, None], axis=0)
        new_row = -np.logaddexp.reduce(kernel + new_column, axis=1)
        shift = np.average(new_column - column, weights=np.exp(log_nu))
        change = max(np.abs(new_row - row + shift).max(), np.abs(new_column - column - shift).max())
        row, column = new_row, new_column
        if change <= tolerance:
            return count
    return limit + 1


@pytest.mark.slow
def test_plain_iterations_are_counted_right_and_others_converge(study: ModuleType) -> None:
    limit = 300
    values = run(study, "acceleration", limit=limit).values
    for (kind, std), tolerance in itertools.product(CASES, (1e-3, 1e-6)):
        lines = {
            v["solver"]: v
            for v in values
            if (v["kind"], v["std"], v["tolerance"]) == (kind, std, tolerance)
        }
        counts = np.array(
            [iterations_to(tolerance, one, limit) for one in scores_of(study, kind, std)]
        )
        assert lines["plain"]["median"] == np.median(np.minimum(counts, limit))
        assert lines["plain"]["largest"] == min(counts.max(), limit)
        assert lines["plain"]["missed"] == (counts > limit).sum()
        for name in ("relaxation 1.8", "Anderson 10", "Newton"):
            # Sharper scores, of few patches, have plans that need more iterations.
            assert std == 10 or lines[name]["missed"] == 0
        for name in lines:
            # A change is of logarithms; 1e-3 of them is this much more of a mass.
            assert lines[name]["largest error of those that met it"] < 1.001 * tolerance


@pytest.mark.slow
def test_sharper_scores_are_counted_right_and_newton_meets_them(study: ModuleType) -> None:
    limit = 400
    values = run(study, "sharpness", limit=limit).values
    assert len(values) == len(study.FORMATS) * len(study.EPSILONS) * len(study.SOLVERS)
    found = {(v["dtype"], v["epsilon"], v["solver"]): v for v in values}
    for epsilon in study.EPSILONS:
        scores = study.cosines(size(study)) / epsilon
        # In float32 a change near the tolerance may round to either side: its counts are not said.
        counts = np.array([iterations_to(1e-6, one, limit) for one in scores])
        plain = found["float64", epsilon, "plain"]
        assert plain["median"] == np.median(np.minimum(counts, limit))
        assert plain["missed"] == (counts > limit).sum()
        for dtype, tolerance in study.FORMATS.items():
            newton = found[dtype, epsilon, "Newton"]
            assert newton["missed"] == 0
            # A change is of logarithms; 1e-3 of them is this much more of a mass.
            assert newton["error"] < 1.001 * tolerance
    assert found["float64", 2e-4, "plain"]["missed"] == IMAGES


@pytest.mark.slow
def test_rounded_scores_are_as_far_off_as_numpy_says(study: ModuleType) -> None:
    values = run(study, "precision").values
    for kind, std in CASES:
        found = {v["way"]: v["worst"] for v in values if (v["kind"], v["std"]) == (kind, std)}
        scores = scores_of(study, kind, std)
        for name, dtype in (("bfloat16", ml_dtypes.bfloat16), ("float16", np.float16)):
            worst = max(
                np.abs(plan_of(one.astype(dtype).astype(np.float64), 3) - plan_of(one, 3)).max()
                for one in scores
            )
            # What float32 adds: about 1e-6 at scores of 30.
            np.testing.assert_allclose(found[f"{name} scores, float32 inside"], worst, atol=1e-5)
            # Once more at least than the scores' own rounding.
            assert found[f"{name} inside"] > 1e-4 > found["float32, scaling domain"]


def test_a_rounded_step_that_rounds_nothing_is_the_step(study: ModuleType) -> None:
    scores = jnp.asarray(scores_of(study, "iid", 3.0), jnp.float32)
    whole = study.RoundedStep(exponent=8, mantissa=23)
    found = study.solve_published(scores, SinkhornConfig(step=whole, domain="log")).log_plan
    expected = study.solve_published(scores, SinkhornConfig(domain="log")).log_plan
    np.testing.assert_allclose(found, expected, atol=1e-5)  # float32 at numbers of order 20


@pytest.mark.slow
def test_only_the_published_dustbin_is_dead(study: ModuleType) -> None:
    values = run(study, "dustbin", images=1).values
    for v in values:
        if v["dustbin"].startswith("column (published"):
            assert max(v["slope"], v["move"]) < 1e-13
        elif v["std"] == 1:
            assert min(v["slope"], v["move"]) > 1e-4
    weights = np.random.default_rng(1).standard_normal((1, PATCHES, CLUSTERS))[0]
    scores = scores_of(study, "iid", 3.0, images=1)[0]

    def with_mass(z: np.ndarray) -> np.ndarray:
        return plan_of(scores, 3, share=1 / (1 + np.exp(-z[0])))

    (mass,) = (v for v in values if (v["dustbin"], v["std"]) == ("mass", 3.0))
    # What differences over 2e-5 leave.
    np.testing.assert_allclose(
        mass["slope"], abs(slopes(with_mass, np.zeros(1), weights)[0]), atol=1e-7
    )
    np.testing.assert_allclose(
        mass["move"],
        np.abs(with_mass(np.ones(1)) - with_mass(np.zeros(1)))[:, :-1].max(),
        atol=1e-12,  # float64
    )


def test_the_page_links_every_table_and_picture(study: ModuleType) -> None:
    page = STUDIES.read_text(encoding="utf-8")
    for name in {*study.STUDIES, "bench_fixed", "bench_converged", "recall"}:
        for link in (f"sinkhorn/{name}.md", f"sinkhorn/{name}.png"):
            assert f"({link})" in page
            assert (PAGE.parent / link).exists()


@pytest.mark.parametrize(
    ("given", "written"), [(0.123, "0.12"), (0.000123, "1.2e-04"), (12345, "1.2e+04"), (1, "1")]
)
def test_numbers_have_two_digits(scripts: Any, given: float, written: str) -> None:
    assert scripts("tables").number(given) == written


def test_a_study_is_a_page_and_its_values(scripts: Any, tmp_path: pathlib.Path) -> None:
    tables = scripts("tables")
    table = tables.Table(("what", "number"), [("a", "1"), ("b", "2")], "Caption.")
    tables.save("world", tables.Study(table, {"a": 1}), tmp_path)
    rows = "| what | number |\n| --- | ---: |\n| a | 1 |\n| b | 2 |\n"
    expected = f"# Variations of the rendered world\n\nCaption.\n\n{rows}"
    assert (tmp_path / "world.md").read_text() == expected
    assert json.loads((tmp_path / "world.json").read_text()) == {"a": 1}


def test_studies_may_be_chosen(scripts: Any, tmp_path: pathlib.Path, monkeypatch) -> None:
    tables = scripts("tables")
    monkeypatch.setattr(sys, "argv", ["study", "--out", str(tmp_path), "world"])
    asked = tables.read_some(tables.flags("", "docs"), ["world", "encoder"])
    assert (asked.studies, asked.out) == (["world"], tmp_path)
    monkeypatch.setattr(sys, "argv", ["study"])
    assert tables.read_some(tables.flags("", str(tmp_path)), ["world"]).studies == ["world"]


def snippets() -> list[str]:
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


def snippet_with(words: str) -> str:
    (found,) = (snippet for snippet in snippets() if words in snippet)
    return found


@pytest.mark.slow
def test_the_dead_dustbin_snippet_shows_what_the_page_says() -> None:
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(snippets()[0], {})
    found = dict(line.rsplit(": ", 1) for line in printed.getvalue().splitlines())
    assert list(found) == ["column", "row and column", "mass"]
    # Rounding of float64, of 16,384 terms.
    assert float(found["column"]) < 1e-14
    assert min(float(found["row and column"]), float(found["mass"])) > 1e-3


@own_steps()
def test_the_ten_line_variant_is_the_capped_transport_that_scipy_finds() -> None:
    """Which maximises the dual under the bounds that the page gives."""
    names: dict[str, Any] = {}
    snippet = snippet_with("def capacity_step")
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(snippet, names)
    source = re.search(r"def capacity_step.*?return Potentials.*?\n", snippet, re.DOTALL)
    assert source is not None
    assert len([line for line in source[0].splitlines() if line]) <= 10
    shares = re.findall(r"(\d+)% of clusters", printed.getvalue())
    assert shares[0] == "0"
    assert 50 < int(shares[2]) < 100
    image = np.asarray(names["scores"][0], np.float64)

    def masses(dustbin: float) -> np.ndarray:
        def minus_dual(column: np.ndarray) -> tuple[float, np.ndarray]:
            full = np.column_stack([image + column, np.full(len(image), dustbin)])
            each = scipy.special.softmax(full, axis=1)[:, :-1].sum(axis=0)
            return scipy.special.logsumexp(full, axis=1).sum() - column.sum(), each - 1

        found = scipy.optimize.minimize(
            minus_dual, np.zeros(image.shape[1]), jac=True, method="L-BFGS-B",
            bounds=[(None, 0)] * image.shape[1], options={"ftol": 1e-15, "gtol": 1e-10},
        )  # fmt: skip
        return minus_dual(found.x)[1] + 1

    # float32, and what 100 iterations leave.
    found = names["cluster_masses"](jnp.float32(10))[0]
    np.testing.assert_allclose(found, masses(10), atol=1e-4)
    slope = jax.grad(lambda z: names["cluster_masses"](z)[0].sum())(jnp.float32(10))
    # Central differences are off by their step squared.
    difference = (masses(10.01) - masses(9.99)).sum() / 0.02
    np.testing.assert_allclose(slope, difference, rtol=1e-3)


@pytest.fixture(scope="module")
def bench(scripts: Any) -> ModuleType:
    return scripts("bench_sinkhorn")


def test_the_published_algorithm_in_torch_is_that_of_numpy(bench: ModuleType) -> None:
    inputs = bench.Inputs.random(2, PATCHES, CLUSTERS, 3.0, seed=0)
    torch_one = bench.by_torch("torch", inputs, 3, compiled=False)
    # The dustbin's score is no matter, and plan_of's is another one.
    expected = [plan_of(one.astype(np.float64), 3) for one in inputs.scores]
    np.testing.assert_allclose(torch_one.plan(), expected, atol=1e-6)  # float32
    expected = slopes(
        lambda at: plan_of(at, 3), inputs.scores[0].astype(np.float64), inputs.weights[0]
    )
    np.testing.assert_allclose(torch_one.gradient()[0].ravel(), expected, atol=1e-5)  # float32
    # Of its log-sum-exps at least one array is kept for the gradient.
    assert torch_one.memory() > inputs.scores.nbytes


def test_unequal_contenders_are_not_timed(bench: ModuleType) -> None:
    inputs = bench.Inputs.random(2, PATCHES, CLUSTERS, 3.0, seed=0)
    reference = bench.by_torch("torch", inputs, 3, compiled=False)
    same = bench.ours("same", SinkhornConfig()).on(inputs)
    other = bench.ours("other", SinkhornConfig(iterations=4)).on(inputs)
    bench.check([reference, same])
    with pytest.raises(RuntimeError, match="other: plan differs from torch's"):
        bench.check([reference, same, other])
    blind = same._replace(name="blind", gradient=lambda: 0 * same.gradient())
    with pytest.raises(RuntimeError, match="blind: gradient differs from torch's"):
        bench.check([reference, blind])


@pytest.fixture(scope="module")
def recalls(scripts: Any) -> ModuleType:
    return scripts("study_transport")


def test_recalls_are_averaged_over_seeds(recalls: ModuleType) -> None:
    def one(value: float) -> dict[str, float]:
        return dict.fromkeys(recalls.DIGITS, value)

    results = {"a": {"x": [one(50.0), one(60.0), one(70.0)]}, "b": {"x": [one(1.0), one(2.0)]}}
    table = recalls.study_of(results).table
    assert [row[:3] for row in table.rows] == [
        ("a", "x", "60.0 ± 10.0"),
        ("b", "x", "1.5 ± 0.7"),  # the root of 2 * 0.5^2
    ]
    assert len(table.rows[0]) == len(table.header)
    assert "3 seeds" in table.caption


@pytest.mark.slow
def test_recall_by_variant_end_to_end(
    recalls: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: pathlib.Path
) -> None:
    """And a second call finds the trainings done, to the same figures."""
    kept = ("published, k = 3", "dustbin a token")
    arguments = ["", "--runs", f"{tmp_path}/runs", "--out", f"{tmp_path}/out", "--seeds", "4"]
    monkeypatch.setattr(sys, "argv", [*arguments, "--epochs", "1", "--variants", *kept])
    tables = []
    for _ in range(2):
        recalls.main()
        tables.append((tmp_path / "out" / "recall.md").read_text())
    assert tables[0] == tables[1]
    values = json.loads((tmp_path / "out" / "recall.json").read_text())["synthetic city"]
    assert list(values) == list(kept)
    assert all(0 < one["R@1"] <= one["R@5"] <= 100 for runs in values.values() for one in runs)
    assert values[kept[0]][0] != values[kept[1]][0]
    assert (tmp_path / "out" / "recall.png").stat().st_size > 10_000
