"""Measure time and memory of the transport, forward and backward, against torch and ott-jax.

    python scripts/bench/bench_sinkhorn.py [--out DIR] [BENCH ...]

It needs torch (the `dev` extra); ott-jax is included if it is installed. It runs on a GPU if both
jax and torch find one. Before anything is timed, plans and gradients are checked to be equal, up to
rounding or to the requested error. If ott-jax's gradient raises, its traceback is printed and the
failure counted.

`timing.py` explains how contenders are timed.

Memory is the peak that a call needs beyond its inputs and the gradients that it returns. For jax,
it is the compiled program's `temp_size_in_bytes`; for torch, the peak of allocations minus releases
in its profiler (on a GPU, of its allocator's counter).
"""

import argparse
import functools
import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import torch
from tables import Study, Table, bars, count, flags, leave, read_some
from timing import measured, megabytes, race, ratio, times, torch_memory, wait

from crisalad_jax.sinkhorn import (
    Implicit,
    SinkhornConfig,
    append_dustbin,
    assign_with_dustbin,
    log_marginals,
)

try:
    from ott.geometry.geometry import Geometry
    from ott.problems.linear.linear_problem import LinearProblem
    from ott.solvers.linear.sinkhorn import Sinkhorn as OttSinkhorn
except ImportError:
    OttSinkhorn = None

DUSTBIN = 1.0
TOLERANCES = tuple(10 ** (-i / 2) for i in range(2, 15))
"""Tried from the loosest on, until the measured error is small enough."""
MOST_ITERATIONS = 500


class Inputs(NamedTuple):
    scores: np.ndarray
    """(images, patches, clusters), as are the weights."""
    weights: np.ndarray
    """The loss is the sum of the weights times the clusters' part of the plan."""

    @classmethod
    def random(cls, images: int, patches: int, clusters: int, std: float, seed: int) -> "Inputs":
        generator = np.random.default_rng(seed)
        shape = (images, patches, clusters)
        scores, weights = (generator.standard_normal(shape).astype(np.float32) for _ in range(2))
        return cls(np.float32(std) * scores, weights)


class Contender(NamedTuple):
    name: str
    call: Callable[[], Any]
    """Runs forward and backward, waits, and returns the gradients."""
    plan: Callable[[], np.ndarray]
    """(images, patches, clusters + 1)."""
    gradient: Callable[[], np.ndarray]
    """The gradient with respect to the scores, in their layout."""
    memory: Callable[[], int]
    """In bytes."""


LogPlan = Callable[[jax.Array, jax.Array], jax.Array]


class Entry(NamedTuple):
    """A program that is compiled once, for inputs of one shape."""

    name: str
    on: Callable[[Inputs], Contender]


def by_jax(name: str, log_plan: LogPlan) -> Entry:
    """Make an entry of `log_plan`: scores and dustbin score to (images, patches, clusters + 1)."""

    def loss(scores: jax.Array, dustbin: jax.Array, weights: jax.Array) -> jax.Array:
        return (weights * jnp.exp(log_plan(scores, dustbin)[..., :-1])).sum()

    forward, both = jax.jit(log_plan), jax.jit(jax.grad(loss, argnums=(0, 1)))

    def on(inputs: Inputs) -> Contender:
        leaves = (jnp.asarray(inputs.scores), jnp.float32(DUSTBIN))
        weights = jnp.asarray(inputs.weights)

        def call() -> Any:
            return jax.block_until_ready(both(*leaves, weights))

        def plan() -> np.ndarray:
            return np.exp(np.asarray(forward(*leaves)))

        def memory() -> int:
            analysis: Any = both.lower(*leaves, weights).compile().memory_analysis()
            return analysis.temp_size_in_bytes

        return Contender(name, call, plan, lambda: np.asarray(call()[0]), memory)

    return Entry(name, on)


def ours(name: str, config: SinkhornConfig) -> Entry:
    return by_jax(name, lambda scores, z: assign_with_dustbin(scores, z, config=config).log_plan)


def by_ott(name: str, solver: Any) -> Entry:
    def log_plan(scores: jax.Array, dustbin: jax.Array) -> jax.Array:
        patches, clusters = scores.shape[1:]
        mu, nu = (jnp.exp(x) / patches for x in log_marginals(patches, clusters))

        def one(full: jax.Array) -> jax.Array:
            found = solver(LinearProblem(Geometry(cost_matrix=-full, epsilon=1.0), a=mu, b=nu))
            return full + found.f[:, None] + found.g + math.log(patches)

        return jax.vmap(one)(append_dustbin(scores, dustbin))

    return by_jax(name, log_plan)


def published(scores: torch.Tensor, dustbin: torch.Tensor, iterations: int) -> torch.Tensor:
    """Compute SALAD's transport in its layout, (images, clusters + 1, patches): Eqs. 4 to 6."""
    images, clusters, patches = scores.shape
    full = torch.cat([scores, dustbin.expand(images, 1, patches)], dim=1)
    log_nu = scores.new_zeros(clusters + 1)
    log_nu[-1] = math.log(patches - clusters)
    row = scores.new_zeros(images, patches)
    column = scores.new_zeros(images, clusters + 1)
    for _ in range(iterations):
        column = log_nu - torch.logsumexp(full + row[:, None, :], dim=2)
        row = -torch.logsumexp(full + column[:, :, None], dim=1)
    return full + column[:, :, None] + row[:, None, :]


def by_torch(name: str, inputs: Inputs, iterations: int, compiled: bool) -> Contender:
    device = "cuda" if torch.cuda.is_available() else "cpu"
    scores, weights = (torch.from_numpy(x).mT.contiguous().to(device) for x in inputs)
    dustbin = torch.tensor(DUSTBIN, device=device)
    leaves = (scores.requires_grad_(), dustbin.requires_grad_())

    def loss(scores: torch.Tensor, dustbin: torch.Tensor) -> torch.Tensor:
        return (weights * published(scores, dustbin, iterations)[:, :-1].exp()).sum()

    if compiled:
        loss = torch.compile(loss, dynamic=False)

    def call() -> tuple[torch.Tensor, ...]:
        found = torch.autograd.grad(loss(*leaves), leaves)
        wait()
        return found

    def plan() -> np.ndarray:
        with torch.no_grad():
            return published(scores, dustbin, iterations).exp().mT.cpu().numpy()

    def memory() -> int:
        return torch_memory(call) - 4 * (scores.numel() + 1)

    return Contender(name, call, plan, lambda: call()[0].mT.cpu().numpy(), memory)


def check(contenders: list[Contender], tolerance: float = 1e-4) -> None:
    """Check that plans and gradients are equal, by default up to float32 rounding.

    Raises:
        RuntimeError: they are not.
    """
    for part in ("plan", "gradient"):
        first, *others = ((one.name, getattr(one, part)().astype(np.float64)) for one in contenders)
        for name, found in others:
            off = np.abs(found - first[1]).max() / np.abs(first[1]).max()
            # 1e-4: hundreds of float32 terms over 3 to 20 iterations; another algorithm differs by
            # 1e-2.
            if not off < tolerance:
                raise RuntimeError(f"{name}: {part} differs from {first[0]}'s by {off:.1e}")


def fixed(arguments: argparse.Namespace) -> Study:
    """Time a fixed number of iterations."""
    values, rows = [], []
    for iterations, patches in itertools.product(arguments.iterations, arguments.patches):
        inputs = Inputs.random(arguments.images, patches, arguments.clusters, arguments.std, 0)
        config = functools.partial(SinkhornConfig, iterations=iterations)
        contenders = [
            by_torch("torch eager", inputs, iterations, compiled=False),
            by_torch("torch.compile", inputs, iterations, compiled=True),
            ours("ours", config()).on(inputs),
            ours("ours, log domain", config(domain="log")).on(inputs),
        ]
        if OttSinkhorn is not None:
            solver = OttSinkhorn(
                min_iterations=iterations,
                max_iterations=iterations,
                # With the default of 10, 3 iterations would be none at all; with more than one
                # block of iterations, the gradient is wrong.
                inner_iterations=iterations,
                implicit_diff=None,
            )
            contenders.append(by_ott("ott-jax, unrolled", solver).on(inputs))
        check(contenders)
        timed = race({one.name: one.call for one in contenders}, arguments.rounds, arguments.calls)
        memory = {one.name: one.memory() for one in contenders}
        torches = ("torch eager", "torch.compile")
        best = min(torches, key=lambda name: timed[name].median)
        least = min(memory[name] for name in torches)
        for one in contenders:
            faster = ratio(timed[best], timed[one.name])
            slower = ratio(timed[one.name], timed["ours"])
            values.append(
                {
                    "patches": patches,
                    "iterations": iterations,
                    "contender": one.name,
                    "ms": timed[one.name].rounds,
                    "over ours": slower,
                    "faster than the better torch": faster,
                    "memory": memory[one.name],
                    "memory over the lesser torch's": memory[one.name] / least,
                }
            )
            cells = (times(slower), times(faster), megabytes(memory[one.name]))
            share = f"{memory[one.name] / least:.2f}"
            rows.append((f"{iterations}", f"{patches}", one.name, *cells, share))
    figure = bars(
        values,
        lambda v: f"k = {v['iterations']}, N = {v['patches']}",
        "over ours",
        "time over ours",
    )
    header = ("k", "N", "contender", "time relative to ours", "speedup", "MB", "share of MB")
    caption = (
        f"A fixed number of iterations k, forward and backward, {describe(arguments)}: time "
        "relative to ours, speedup over the faster of torch eager and torch.compile, memory, and "
        "its share of the smaller memory of these two."
    )
    return Study(Table(header, rows, caption, 3), values, figure)


def describe(arguments: argparse.Namespace) -> str:
    return (
        f"B = {arguments.images}, m = {arguments.clusters}, iid scores of standard deviation "
        f"{arguments.std:g}, float32, {measured(arguments.rounds)} of {arguments.calls} calls"
    )


def marginal_error(plan: np.ndarray) -> float:
    """Measure the largest relative error of a row's or column's mass, in float64."""
    plan = plan.astype(np.float64)
    patches, clusters = plan.shape[1], plan.shape[2] - 1
    masses = np.append(np.ones(clusters), patches - clusters)
    columns = np.abs(plan.sum(axis=1) / masses - 1).max()
    return float(max(columns, np.abs(plan.sum(axis=2) - 1).max()))


def works(contender: Contender) -> bool:
    """Return whether nothing raises and the gradient is finite."""
    try:
        return bool(np.isfinite(contender.gradient()).all())
    except RuntimeError:  # jax's own and equinox's
        return False


def converging() -> dict[str, Callable[[float], Entry]]:
    """Return functions from a tolerance to a program, by name."""

    def own(name: str, fields: dict[str, Any], tolerance: float) -> Entry:
        config = SinkhornConfig(
            tolerance=tolerance, iterations=MOST_ITERATIONS, gradient=Implicit(), **fields
        )
        return ours(name, config)

    def other(name: str, inner: int, tolerance: float) -> Entry:
        solver = OttSinkhorn(  # pyright: ignore[reportOptionalCall]
            threshold=tolerance, inner_iterations=inner, max_iterations=MOST_ITERATIONS
        )
        return by_ott(name, solver)

    variants: dict[str, dict[str, Any]] = {
        "ours": {},
        "ours, Anderson 10": {"anderson_memory": 10},
        "ours, Newton": {"step": "newton"},
    }
    found = {name: functools.partial(own, name, fields) for name, fields in variants.items()}
    if OttSinkhorn is not None:
        for inner in (1, 10):
            name = f"ott-jax, checked every {inner}"
            found[name] = functools.partial(other, name, inner)
    return found


def loosest(program: Callable[[float], Entry], inputs: Inputs, target: float) -> float | None:
    """Find the loosest tolerance whose measured error is at most `target`."""
    for tolerance in TOLERANCES:
        if marginal_error(program(tolerance).on(inputs).plan()) <= target:
            return tolerance
    return None


def converged(arguments: argparse.Namespace) -> Study:
    """Time convergence to a measured marginal error, with the implicit gradient."""
    values, rows = [], []
    for target, patches in itertools.product(arguments.errors, arguments.patches):
        batches = [
            Inputs.random(arguments.images, patches, arguments.clusters, arguments.std, seed)
            for seed in range(arguments.batches)
        ]
        lines: dict[str, dict[str, Any]] = {}
        working: dict[str, dict[int, Contender]] = {}
        for name, program in converging().items():
            line = lines[name] = {"patches": patches, "target": target, "contender": name}
            tolerance = loosest(program, batches[0], target)
            if tolerance is None:
                continue
            entry = program(tolerance)
            found = {i: entry.on(batch) for i, batch in enumerate(batches)}
            working[name] = {i: one for i, one in found.items() if works(one)}
            line |= {"tolerance": tolerance, "failures": len(found) - len(working[name])}
            line["error"] = marginal_error(found[0].plan())
        # All run on one batch: the first of those on which the most contenders work.
        batch = max(range(len(batches)), key=lambda i: sum(i in one for one in working.values()))
        entered = [one[batch] for one in working.values() if batch in one]
        for one in entered:
            lines[one.name]["error"] = marginal_error(one.plan())
        if entered:
            # For sharp plans, gradients change several times as much as masses.
            check(entered, 30 * target)
        timed = race({one.name: one.call for one in entered}, arguments.rounds, arguments.calls)
        theirs = [name for name in timed if name.startswith("ott")]
        best = min(theirs, key=lambda name: timed[name].median, default=None)
        for one in entered:
            lines[one.name] |= {"ms": timed[one.name].rounds, "memory": one.memory()}
            lines[one.name]["over ours"] = ratio(timed[one.name], timed["ours"])
            if best is not None:
                lines[one.name]["faster than ott-jax"] = ratio(timed[best], timed[one.name])
        for name, line in lines.items():
            cells = ["not met"] * 5
            if "error" in line:
                failed = f"{line['failures']} of {len(batches)}"
                cells = [f"{line['error']:.1e}", "raises", "", "", failed]
            if name in timed:
                cells[1:4] = times(line["over ours"]), "", megabytes(line["memory"])
                if best is not None:
                    cells[2] = times(line["faster than ott-jax"])
            rows.append((f"{target:g}", f"{patches}", name, *cells))
            values.append(line)
    figure = bars(
        [line for line in values if "ms" in line],
        lambda line: f"to {line['target']:g}, N = {line['patches']}",
        "over ours",
        "time over ours",
    )
    header = (
        *("error", "N", "contender", "measured"),
        *("time relative to ours", "speedup", "MB", "failures"),
    )
    caption = (
        "To a measured largest relative marginal error, implicit gradient, forward and backward, "
        f"{describe(arguments)}. Each contender uses the loosest tolerance, in half decades, that "
        "reaches the error on the first batch; all are timed and measured on one batch, the first "
        'of those on which the most contenders work. "Time relative to ours": to our plain '
        'iterations. "Speedup": over the faster ott-jax. "Failures": how many of '
        f"{arguments.batches} batches raise or are not finite."
    )
    return Study(Table(header, rows, caption, 3), values, figure)


BENCHES = {"bench_fixed": fixed, "bench_converged": converged}


def main() -> None:
    parser = flags("Time the transport; see the module docstring.", "docs/sinkhorn")
    parser.add_argument("--images", type=count, default=32)
    parser.add_argument("--clusters", type=count, default=64)
    parser.add_argument("--patches", type=count, nargs="+", default=[256, 529])
    parser.add_argument("--iterations", type=count, nargs="+", default=[3, 20])
    parser.add_argument("--errors", type=float, nargs="+", default=[1e-3, 1e-5])
    parser.add_argument("--std", type=float, default=3.0)
    parser.add_argument("--rounds", type=count, default=5)
    parser.add_argument("--calls", type=count, default=20)
    parser.add_argument("--batches", type=count, default=8, help="batches to count failures in")
    arguments = read_some(parser, BENCHES)
    for name in arguments.studies:
        leave(name, BENCHES[name](arguments), arguments)


if __name__ == "__main__":
    main()
