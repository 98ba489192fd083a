"""Tabulate and plot how the transport converges, on random scores.

    python scripts/bench/study_sinkhorn.py [--out DIR] [STUDY ...]

There are two kinds of scores, each for a batch of images: "iid", independent Gaussians; "lowrank",
inner products of rank 4 plus a bias per cluster, closer to the output of a network. Each is scaled
to a standard deviation. It takes a few minutes.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tables import COLOURS, Study, Table, count, flags, leave, number, panels, read_some

from crisalad_jax.sinkhorn import (
    Implicit,
    Potentials,
    Problem,
    SinkhornConfig,
    SinkhornResult,
    SinkhornStep,
    Step,
    Stop,
    append_dustbin,
    assign_with_dustbin,
    log_marginals,
    register_step,
    solve,
)

KINDS = ("iid", "lowrank")
SCALES = (1.0, 3.0, 10.0)
PUBLISHED = SinkhornConfig()


class Size(NamedTuple):
    images: int = 32
    patches: int = 256
    clusters: int = 64
    limit: int = 2000
    """Maximum number of iterations to reach a tolerance."""


def scores_of(kind: str, scale: float, size: Size, seed: int = 0) -> np.ndarray:
    """Draw scores (images, patches, clusters) in float64 with standard deviation `scale`."""
    generator = np.random.default_rng(seed)
    shape = (size.images, size.patches, size.clusters)
    if kind == "iid":
        return scale * generator.standard_normal(shape)
    patches = generator.standard_normal((size.images, size.patches, 4))
    clusters = generator.standard_normal((size.clusters, 4))
    # The bias contributes half as much as the products, whose standard deviation is 2.
    scores = patches @ clusters.T + generator.standard_normal(size.clusters)
    return scale * scores / scores.std()


def cases(size: Size) -> Iterator[tuple[str, float, jax.Array]]:
    for kind in KINDS:
        for scale in SCALES:
            yield kind, scale, jnp.asarray(scores_of(kind, scale, size))


def solve_published(scores: jax.Array, config: SinkhornConfig = PUBLISHED) -> SinkhornResult:
    """Solve with a column of zeros for the dustbin, as published."""
    marginals = log_marginals(*scores.shape[-2:], dtype=scores.dtype)
    full = append_dustbin(scores, jnp.zeros((), scores.dtype))
    return solve(full, *marginals, config=config)


def middle_and_most(values: Any) -> tuple[float, float]:
    values = np.asarray(values, np.float64)
    return float(np.median(values)), float(values.max())


def error(size: Size) -> Study:
    """Tabulate the marginal error against the number of iterations."""
    counts = [k for k in (1, 2, 3, 5, 10, 20, 50, 100) if k <= size.limit]
    values = []
    for kind, scale, scores in cases(size):
        for k in counts:
            found = solve_published(scores, SinkhornConfig(iterations=k)).column_error
            median, largest = middle_and_most(found)
            values.append(
                {"kind": kind, "std": scale, "k": k, "median": median, "largest": largest}
            )
    rows = []
    figure, axes = panels(len(KINDS), KINDS)
    for one, kind in zip(axes, KINDS, strict=True):
        for colour, scale in zip(COLOURS, SCALES, strict=False):
            line = [v for v in values if (v["kind"], v["std"]) == (kind, scale)]
            cells = (f"{number(v['median'])} ({number(v['largest'])})" for v in line)
            rows.append((kind, f"{scale:g}", *cells))
            # The last place of float64, below which there is only noise.
            middle, most = (
                np.maximum([v[name] for v in line], 1e-15) for name in ("median", "largest")
            )
            one.loglog(counts, middle, "o-", color=colour, markersize=3, label=f"std {scale:g}")
            one.fill_between(counts, middle, most, color=colour, alpha=0.2, linewidth=0)
        one.axvline(PUBLISHED.iterations, color="black", linewidth=0.8, linestyle=":")
        one.set_xlabel("iterations k (dotted: the published 3)")
    axes[0].set_ylabel("largest relative error\nof a cluster's mass")
    axes[0].legend(frameon=False, fontsize=8)
    caption = (
        f"Largest relative error of a cluster's mass after k iterations, float64: median of "
        f"{size.images} images (and the worst), {size.patches} patches, {size.clusters} clusters."
    )
    header = ("scores", "std", *(f"k = {k}" for k in counts))
    return Study(Table(header, rows, caption, 2), values, figure)


def mass(size: Size) -> Study:
    """Tabulate the cluster masses, which should be 1, after the published iterations."""
    values, rows, masses = [], [], []
    for kind, scale, scores in cases(size):
        plan = jnp.exp(solve_published(scores, PUBLISHED).log_plan)
        found = np.asarray(plan.sum(axis=-2))[:, :-1]
        masses.append(found.ravel())
        one = {
            "kind": kind,
            "std": scale,
            "smallest": float(found.min()),
            "largest": float(found.max()),
            "mean worst error": float(np.abs(found - 1).max(axis=1).mean()),
        }
        values.append(one)
        numbers = (f"{one[name]:.3f}" for name in ("smallest", "largest"))
        rows.append((kind, f"{scale:g}", *numbers, number(one["mean worst error"])))
    figure, axes = panels(len(KINDS), KINDS)
    for number_of_kind, one in enumerate(axes):
        chosen = masses[number_of_kind * len(SCALES) : (number_of_kind + 1) * len(SCALES)]
        drawn = one.boxplot(chosen, whis=(0, 100), widths=0.5, patch_artist=True)
        for box, line, colour in zip(drawn["boxes"], drawn["medians"], COLOURS, strict=False):
            box.set(facecolor=colour, alpha=0.4)
            line.set_color("black")
        one.set_xticks(range(1, len(SCALES) + 1), [f"std {scale:g}" for scale in SCALES])
        one.axhline(1, color="black", linewidth=0.8, linestyle=":")
    axes[0].set_ylabel("mass of a cluster (should be 1)")
    caption = (
        f"Masses of the clusters after the published 3 iterations, {size.images} images: the "
        "smallest, the largest, and the mean over images of the worst error."
    )
    header = ("scores", "std", "smallest", "largest", "mean worst error")
    return Study(Table(header, rows, caption, 2), values, figure)


def gradient(size: Size) -> Study:
    """Compare the gradient through k iterations with that of the converged plan."""
    counts = (1, 3, 10, 50)
    shape = (size.images, size.patches, size.clusters)
    weights = jnp.asarray(np.random.default_rng(1).standard_normal(shape))

    @functools.partial(jax.jit, static_argnames="config")
    def gradient_of(scores: jax.Array, config: SinkhornConfig) -> tuple[jax.Array, jax.Array]:
        def loss(scores: jax.Array) -> tuple[jax.Array, jax.Array]:
            result = solve_published(scores, config)
            return (weights * jnp.exp(result.log_plan[..., :-1])).sum(), result.converged

        found, converged = jax.grad(loss, has_aux=True)(scores)
        return found.reshape(size.images, -1), converged.all()

    exact = SinkhornConfig(
        tolerance=1e-11, iterations=5000, anderson_memory=10, gradient=Implicit()
    )
    values, rows = [], []
    figure, axes = panels(2, ("relative difference", "1 - cosine"), width=5, sharey=False)
    for position, (kind, scale, scores) in enumerate(cases(size)):
        reference, converged = gradient_of(scores, exact)
        if not converged:
            raise RuntimeError(f"no converged plan to compare with: {kind}, std {scale}")
        line = []
        for k in counts:
            found, _ = gradient_of(scores, SinkhornConfig(iterations=k))
            norms = [jnp.linalg.norm(x, axis=1) for x in (found, reference)]
            difference = jnp.linalg.norm(found - reference, axis=1) / norms[1]
            cosine = (found * reference).sum(axis=1) / (norms[0] * norms[1])
            one = {
                "kind": kind,
                "std": scale,
                "k": k,
                "relative": float(jnp.median(difference)),
                "cosine": float(jnp.median(cosine)),
                "worst cosine": float(cosine.min()),
            }
            line.append(one)
        values += line
        cells = (f"{v['cosine']:.4f}, {number(v['relative'])}" for v in line)
        rows.append((kind, f"{scale:g}", *cells))
        style = {
            "color": COLOURS[position % len(SCALES)],
            "linestyle": ("-", "--")[position // len(SCALES)],
            "label": f"{kind}, std {scale:g}",
            "marker": "o",
            "markersize": 3,
        }
        axes[0].loglog(counts, [max(v["relative"], 1e-13) for v in line], **style)
        axes[1].loglog(counts, [max(1 - v["cosine"], 1e-16) for v in line], **style)
    for one in axes:
        one.set_xlabel("iterations k")
        one.axvline(PUBLISHED.iterations, color="black", linewidth=0.8, linestyle=":")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    caption = (
        "Gradient with respect to the scores through k iterations, of a random linear function of "
        "the clusters' part of the plan, compared with the converged plan's implicit gradient, "
        f"float64: cosine and relative difference; medians of {size.images} images."
    )
    header = ("scores", "std", *(f"k = {k}" for k in counts))
    return Study(Table(header, rows, caption, 2), values, figure)


SOLVERS: dict[str, dict[str, Any]] = {
    "plain": {},
    "relaxation 1.5": {"step": SinkhornStep(relaxation=1.5)},
    "relaxation 1.8": {"step": SinkhornStep(relaxation=1.8)},
    "Anderson 10": {"anderson_memory": 10},
    "Nesterov": {"step": "nesterov"},
    "Newton": {"step": "newton"},
}


def acceleration(size: Size) -> Study:
    """Count iterations until the tolerance is met."""
    values, rows = [], []
    for kind, scale, scores in cases(size):
        for name, fields in SOLVERS.items():
            cells = []
            for tolerance in (1e-3, 1e-6):
                config = SinkhornConfig(
                    tolerance=tolerance, iterations=size.limit, gradient=Stop(), **fields
                )
                result = solve_published(scores, config)
                median, most = middle_and_most(result.iterations)
                missed = int((~result.converged).sum())
                worst = jnp.maximum(result.row_error, result.column_error)
                one = {
                    "kind": kind,
                    "std": scale,
                    "solver": name,
                    "tolerance": tolerance,
                    "median": median,
                    "largest": most,
                    "missed": missed,
                    "largest error of those that met it": float(
                        jnp.where(result.converged, worst, 0).max()
                    ),
                }
                values.append(one)
                cells.append(f"{median:g} / {most:g}" + (f", {missed} missed" if missed else ""))
            rows.append((kind, f"{scale:g}", name, *cells))
    figure, axes = panels(len(KINDS), tuple(f"{kind}, to 1e-6" for kind in KINDS), width=5)
    for one, kind in zip(axes, KINDS, strict=True):
        for colour, (position, name) in zip(COLOURS, enumerate(SOLVERS), strict=False):
            chosen = [
                v for v in values if (v["kind"], v["solver"], v["tolerance"]) == (kind, name, 1e-6)
            ]
            width = 0.8 / len(SOLVERS)
            places = np.arange(len(SCALES)) + width * (position - (len(SOLVERS) - 1) / 2)
            one.bar(places, [v["median"] for v in chosen], 0.9 * width, color=colour, label=name)
            one.plot(places, [v["largest"] for v in chosen], "_", color=colour, markersize=7)
        one.set_yscale("log")
        one.set_xticks(range(len(SCALES)), [f"std {scale:g}" for scale in SCALES])
    axes[0].set_ylabel("iterations: median (bar), most (dash)")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    caption = (
        f'Iterations to a tolerance, float64: median / maximum of {size.images} images; "missed": '
        f"images that did not meet it in {size.limit}. A Newton iteration costs several others."
    )
    header = ("scores", "std", "solver", "to 1e-3", "to 1e-6")
    return Study(Table(header, rows, caption, 3), values, figure)


EPSILONS = (1.0, 0.1, 1e-2, 1e-3, 2e-4)
FORMATS = {"float32": 1e-3, "float64": 1e-6}
"""The tolerance of each type: float32 can't reach a lower one at the sharpest scores."""
FEW = 8
"""Maximum number of images: at small epsilon, plain iterations run to the limit."""


def cosines(size: Size) -> np.ndarray:
    """Draw cosines of random unit vectors of 16 dimensions."""
    generator = np.random.default_rng(0)
    images = min(size.images, FEW)
    sides = [
        generator.standard_normal((images, count, 16)) for count in (size.patches, size.clusters)
    ]
    patches, clusters = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in sides)
    return patches @ clusters.transpose(0, 2, 1)


def sharpness(size: Size) -> Study:
    """Measure iterations and time of the steps as epsilon decreases."""
    values, rows = [], []
    for dtype, tolerance in FORMATS.items():
        scores = jnp.asarray(cosines(size), dtype)
        full = append_dustbin(scores, jnp.zeros((), dtype))
        marginals = log_marginals(*scores.shape[-2:], dtype=scores.dtype)
        for epsilon in EPSILONS:
            found = {}
            for name, fields in SOLVERS.items():
                config = SinkhornConfig(
                    tolerance=tolerance,
                    iterations=size.limit,
                    gradient=Stop(),
                    # Scores over a smaller epsilon exceed the range of the scaling domain.
                    domain="scaling" if epsilon >= 0.1 else "log",
                    **fields,
                )

                call = functools.partial(solve, full, *marginals, epsilon=epsilon, config=config)
                result = jax.block_until_ready(call())
                times = []
                for _ in range(3):
                    started = time.perf_counter()
                    jax.block_until_ready(call())
                    times.append(time.perf_counter() - started)
                median, most = middle_and_most(result.iterations)
                worst = jnp.maximum(result.row_error, result.column_error)
                found[name] = {
                    "dtype": dtype,
                    "epsilon": epsilon,
                    "solver": name,
                    "median": median,
                    "largest": most,
                    "missed": int((~result.converged).sum()),
                    "error": float(worst.max()),
                    "seconds": min(times),
                }
            values += found.values()
            cells = []
            for name, one in found.items():
                over = one["seconds"] / found["Newton"]["seconds"]
                cell = f"{one['median']:g} / {one['largest']:g}"
                if one["missed"]:
                    cell += f", {one['missed']} missed"
                cells.append(cell if name == "Newton" else f"{cell}, {over:.2g}x")
            rows.append((dtype, f"{epsilon:g}", *cells))
    figure, axes = panels(len(FORMATS), tuple(f"{x}, to {y:g}" for x, y in FORMATS.items()))
    for one, dtype in zip(axes, FORMATS, strict=True):
        for colour, name in zip(COLOURS, SOLVERS, strict=False):
            line = [v for v in values if (v["dtype"], v["solver"]) == (dtype, name)]
            one.loglog(EPSILONS, [v["largest"] for v in line], color=colour, label=name)
            met = [v for v in line if not v["missed"]]
            one.plot([v["epsilon"] for v in met], [v["largest"] for v in met], "o", color=colour)
        one.invert_xaxis()
        one.set_xlabel("epsilon (dot: all met it)")
    axes[0].set_ylabel("iterations, most of the images")
    axes[0].legend(frameon=False, fontsize=8)
    tolerances = ", ".join(f"{x} to {y:g}" for x, y in FORMATS.items())
    caption = (
        f"Cosines of random unit vectors of 16 dimensions, over epsilon; tolerance: {tolerances}. "
        f'Iterations, median / maximum of {min(size.images, FEW)} images; "missed": images that '
        f'did not meet it in {size.limit}; "x": the time of the batch, the minimum of '
        "3 calls, relative to Newton's."
    )
    return Study(Table(("type", "epsilon", *SOLVERS), rows, caption, 2), values, figure)


class Half(NamedTuple):
    name: str
    exponent: int
    mantissa: int


HALVES = (Half("bfloat16", 8, 7), Half("float16", 5, 10))


@register_step("rounded")
@dataclasses.dataclass(frozen=True)
class RoundedStep(Step):
    """The log-domain step with every intermediate result rounded to half precision."""

    exponent: int = HALVES[0].exponent
    mantissa: int = HALVES[0].mantissa

    def step(
        self, problem: Problem, potentials: Potentials, state: Any, iteration: jax.Array
    ) -> tuple[Potentials, Any]:
        kernel = self.rounded(problem.kernel)
        sums = self.log_sum(self.rounded(kernel + potentials.row[..., None]), axis=-2)
        column = self.rounded(problem.log_nu - sums)
        sums = self.log_sum(self.rounded(kernel + column[..., None, :]), axis=-1)
        return Potentials(self.rounded(problem.log_mu - sums), column), state

    def rounded(self, x: jax.Array) -> jax.Array:
        # The compiler removes a cast there and back, but not this.
        return jax.lax.reduce_precision(x, self.exponent, self.mantissa)

    def log_sum(self, x: jax.Array, axis: int) -> jax.Array:
        top = x.max(axis=axis, keepdims=True)
        # Summed in float32, as processors do, and rounded once.
        total = self.rounded(self.rounded(jnp.exp(self.rounded(x - top))).sum(axis=axis))
        return self.rounded(self.rounded(jnp.log(total)) + jnp.squeeze(top, axis))


def precision(size: Size) -> Study:
    """Compare plans of 3 iterations in lower precision with the float64 plan."""

    def plan_of(scores: jax.Array, config: SinkhornConfig = PUBLISHED) -> np.ndarray:
        return np.exp(np.asarray(solve_published(scores, config).log_plan, np.float64))

    logarithmic = SinkhornConfig(domain="log")
    ways: dict[str, Callable[[jax.Array], np.ndarray]] = {
        "float32, scaling domain": plan_of,
        "float32, log domain": lambda scores: plan_of(scores, logarithmic),
    }
    for half in HALVES:
        ways[f"{half.name} scores, float32 inside"] = lambda scores, half=half: plan_of(
            jax.lax.reduce_precision(scores, half.exponent, half.mantissa)
        )
        ways[f"{half.name} inside"] = lambda scores, half=half: plan_of(
            scores, SinkhornConfig(step=RoundedStep(half.exponent, half.mantissa), domain="log")
        )
    values, rows = [], []
    for kind, scale, scores in cases(size):
        exact = plan_of(scores)
        cells = []
        for name, way in ways.items():
            difference = np.abs(way(scores.astype(jnp.float32)) - exact).max(axis=(1, 2))
            median, worst = middle_and_most(difference)
            values.append(
                {"kind": kind, "std": scale, "way": name, "median": median, "worst": worst}
            )
            cells.append(f"{number(median)} ({number(worst)})")
        rows.append((kind, f"{scale:g}", *cells))
    figure, axes = panels(len(KINDS), KINDS, width=5)
    for one, kind in zip(axes, KINDS, strict=True):
        for colour, name in zip(COLOURS, ways, strict=False):
            chosen = [v["median"] for v in values if (v["kind"], v["way"]) == (kind, name)]
            one.plot(SCALES, chosen, "o-", color=colour, markersize=4, label=name)
        one.set(xscale="log", yscale="log", xlabel="standard deviation of the scores")
        one.set_xticks(SCALES, [f"{scale:g}" for scale in SCALES])
        one.minorticks_off()
    axes[0].set_ylabel("largest error in the plan")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    caption = (
        "Largest difference of the plan of 3 iterations from the float64 plan, whose entries are "
        f'at most 1: median of {size.images} images (and the worst). "Inside": every '
        "intermediate result of the transport is rounded to that format."
    )
    header = ("scores", "std", *ways)
    return Study(Table(header, rows, caption, 2), values, figure)


DUSTBINS: dict[str, dict[str, Any]] = {
    "column (published)": {},
    "row and column": {"dustbin": "row and column"},
    "column, column tau 0.9, k = 20": {"column_tau": 0.9, "iterations": 20},
    "token": {"dustbin": "token"},
    "mass": {"dustbin": "mass"},
}


def dustbin(size: Size) -> Study:
    """Measure how much the dustbin's parameter matters, by variant."""
    weights = jnp.asarray(
        np.random.default_rng(1).standard_normal((size.images, size.patches, size.clusters))
    )
    noise = jnp.asarray(np.random.default_rng(2).standard_normal((size.images, size.patches)))

    def measure(
        dustbin: str = "column", iterations: int = PUBLISHED.iterations, column_tau: float = 1.0
    ) -> Callable[[jax.Array], tuple[jax.Array, jax.Array]]:
        """Return the gradient's size and the plan's largest change, by image."""
        token, config = dustbin == "token", SinkhornConfig(iterations=iterations)

        def plan(scores: jax.Array, z: jax.Array) -> jax.Array:
            found = assign_with_dustbin(scores, z, dustbin, column_tau=column_tau, config=config)
            return jnp.exp(found.log_plan[..., :-1])

        def one(scores: jax.Array, weights: jax.Array, noise: jax.Array) -> Any:
            z = jnp.zeros(size.patches if token else (), scores.dtype)
            found = jax.grad(lambda z: (weights * plan(scores, z)).sum())(z)
            moved = plan(scores, noise if token else z + 1) - plan(scores, z)
            return jnp.linalg.norm(found), jnp.abs(moved).max()

        return jax.jit(lambda scores: jax.vmap(one)(scores, weights, noise))

    values, rows = [], []
    for name, fields in DUSTBINS.items():
        cells = []
        measured = measure(**fields)
        for scale in SCALES:
            slopes, moves = measured(jnp.asarray(scores_of("iid", scale, size)))
            slope, move = float(jnp.median(slopes)), float(jnp.median(moves))
            values.append({"dustbin": name, "std": scale, "slope": slope, "move": move})
            cells.append(f"{number(slope)}, {number(move)}")
        rows.append((name, *cells))
    figure, (axes,) = panels(1, ("size of the gradient, by the dustbin's variant",), width=6.5)
    for position, (colour, scale) in enumerate(zip(COLOURS, SCALES, strict=False)):
        chosen = [v["slope"] for v in values if v["std"] == scale]
        places = np.arange(len(DUSTBINS)) + 0.25 * (position - 1)
        axes.bar(places, np.maximum(chosen, 1e-17), 0.22, color=colour, label=f"std {scale:g}")
    axes.set_yscale("log")
    axes.set_ylim(1e-17, 1e3)
    labels = [name.replace(", ", "\n", 1).replace(" (", "\n(") for name in DUSTBINS]
    axes.set_xticks(range(len(DUSTBINS)), labels, fontsize=8)
    axes.set_ylabel("|dL/dz|")
    axes.legend(frameon=False, fontsize=8, ncols=len(SCALES))
    caption = (
        "Effect of the dustbin's parameter z, iid scores, float64, medians of "
        f"{size.images} images: |dL/dz| at z = 0 for L a random linear function of the clusters' "
        "part of the plan, and the largest change of an entry of the plan when z grows by 1 (for "
        "a token: by a standard Gaussian; |dL/dz| is then the norm over tokens)."
    )
    header = ("dustbin", *(f"std {scale:g}" for scale in SCALES))
    return Study(Table(header, rows, caption), values, figure)


STUDIES: dict[str, Callable[[Size], Study]] = {
    "error": error,
    "mass": mass,
    "gradient": gradient,
    "acceleration": acceleration,
    "sharpness": sharpness,
    "precision": precision,
    "dustbin": dustbin,
}


def main() -> None:
    parser = flags("Study the transport; see the module docstring.", "docs/sinkhorn")
    parser.add_argument("--images", type=count, default=Size().images)
    arguments = read_some(parser, STUDIES)
    size = Size(images=arguments.images)
    for name in arguments.studies:
        started = time.monotonic()
        with jax.enable_x64(True):
            study = STUDIES[name](size)
        print(f"{name} ({time.monotonic() - started:.0f} s)\n")
        leave(name, study, arguments)


if __name__ == "__main__":
    main()
