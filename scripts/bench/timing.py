"""Time programs side by side in one run.

Fairness: the contenders take turns, `rounds` times. A turn has three parts: a pause of a quarter of
a second, in which the previous contender's threads stop spinning (OpenMP threads spin after each
call); a quarter of a second of calls that do not count, so that cores and caches are equally warm
for fast and slow contenders; then calls that count, for a quarter of a second and at least `calls`
of them. A ratio is between two medians of the same round; tables show the median of the ratios over
rounds, and the range. All contenders may use any number of threads.
"""

import importlib.metadata
import itertools
import os
import pathlib
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Hashable, Mapping
from typing import Any, NamedTuple, TypeVar

from crisalad_jax.utils.host import usable_cores

# On a GPU, jax would preallocate most of the memory, and leave torch too little.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
# Like the command line, which may use all cores.
os.environ.setdefault("JAX_NUM_CPU_DEVICES", str(usable_cores()))

import jax
import torch

_Name = TypeVar("_Name", bound=Hashable)
# First calls start with an empty cache, whatever ran before.
_KERNELS = tempfile.TemporaryDirectory(prefix="inductor-")
os.environ["TORCHINDUCTOR_CACHE_DIR"] = _KERNELS.name

if torch.cuda.is_available():
    # On a GPU, jax by default rounds the factors of products to 10 bits (TF32), and torch does not.
    jax.config.update("jax_default_matmul_precision", "highest")

PAUSE = 0.25


class Timed(NamedTuple):
    rounds: list[float]
    """The median of each round, in ms: on a CPU absolute times stay in the JSON file."""

    @property
    def median(self) -> float:
        return statistics.median(self.rounds)


def race(
    contenders: Mapping[_Name, Callable[[], Any]], rounds: int, calls: int
) -> dict[_Name, Timed]:
    """Time contenders by name; each call does all of its work and waits for the result."""
    timed = {name: Timed([]) for name in contenders}
    for _ in range(rounds):
        for name, call in contenders.items():
            time.sleep(PAUSE)
            warm = time.perf_counter() + PAUSE
            while time.perf_counter() < warm:
                call()
            times, end = [], time.perf_counter() + PAUSE
            while len(times) < calls or time.perf_counter() < end:
                started = time.perf_counter()
                call()
                times.append(1e3 * (time.perf_counter() - started))
            timed[name].rounds.append(statistics.median(times))
    return timed


def run_program(command: list[str], caches: Mapping[str, str]) -> tuple[float, str]:
    """Run a program with separate caches; return its seconds and its output."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    started = time.perf_counter()
    done = subprocess.run(
        command, env=environment | dict(caches), check=True, stdout=subprocess.PIPE
    )
    return time.perf_counter() - started, done.stdout.decode()


def ratio(slow: Timed, fast: Timed) -> tuple[float, float, float]:
    """Return the speedup of `fast` over `slow`: median over rounds, minimum, maximum."""
    found = [a / b for a, b in zip(slow.rounds, fast.rounds, strict=True)]
    return statistics.median(found), min(found), max(found)


def times(value: tuple[float, float, float]) -> str:
    return f"{value[0]:.2f} ({value[1]:.2f} to {value[2]:.2f})"


def megabytes(size: float) -> str:
    return f"{size / 1e6:.1f}"


def torch_memory(call: Callable[[], Any]) -> int:
    """Measure the peak bytes of a torch call, including what it returns.

    This is the peak of allocations minus releases in the profiler; on a GPU, of the allocator's
    counter.
    """
    if torch.cuda.is_available():
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        call()
        return torch.cuda.max_memory_allocated() - before
    activities = [torch.profiler.ProfilerActivity.CPU]
    with torch.profiler.profile(activities=activities, profile_memory=True) as profile:
        kept = call()
    events: list[Any] = profile.profiler.kineto_results.events()  # pyright: ignore
    events = [event for event in events if event.name() == "[memory]"]
    sizes = [event.nbytes() for event in sorted(events, key=lambda event: event.start_ns())]
    del kept
    return max(itertools.accumulate(sizes), default=0)


def wait() -> None:
    """Wait for pending work of torch on a GPU."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def measured(rounds: int, *packages: str) -> str:
    """Describe the machine and the rounds, for the caption of a table of `ratio`s."""
    return f"{machine(*packages)}; medians and ranges of {rounds} round{'s' * (rounds != 1)}"


def machine(*packages: str) -> str:
    """Describe the machine, with the versions of jax, torch and further packages."""
    device = jax.devices()[0]
    name = device.device_kind
    if device.platform == "cpu":
        info = pathlib.Path("/proc/cpuinfo")
        lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
        models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        name = f"{models[0] if models else 'CPU'}, {usable_cores()} cores"
    versions = (f"{package} {importlib.metadata.version(package)}" for package in packages)
    return ", ".join((name, f"jax {jax.__version__}", f"torch {torch.__version__}", *versions))
