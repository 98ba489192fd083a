"""The work of a comparison as Ray tasks, each with its share of the cluster's devices."""

import contextlib
import math
import os
import pathlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax

from crisalad_jax.config.checks import require
from crisalad_jax.config.plugins import load_plugins, loaded_plugins
from crisalad_jax.data.images import MAX_PIXELS
from crisalad_jax.utils.cluster import START, check_nodes, connected, with_notes
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import counted, warn
from crisalad_jax.utils.signals import defer_signals

_MEMORY = 0.9
"""Fraction of a GPU's memory that all tasks on it may use together."""
_TRIES = 10
"""Number of lost workers after which a task fails."""
_PATIENCE = 300.0
"""Seconds that tasks have to save their work on an interruption; compiling may take minutes."""
_JAX = (
    *("jax_platforms", "jax_num_cpu_devices", "jax_compilation_cache_dir"),
    "jax_persistent_cache_min_compile_time_secs",
)
"""JAX settings that workers inherit as environment variables, for bit-identical runs."""


class Share(NamedTuple):
    """The share of a cluster that each task gets."""

    device: str
    """What a task reserves: "GPU", or "CPU" for cores."""
    size: float
    """Number of GPUs or cores per task; a fraction if tasks share a GPU or core."""
    at_once: int
    """Number of tasks that run at a time."""
    beside: bool
    """Whether tasks share a GPU; without GPUs, whether two tasks may run on one node."""


def share_of(nodes: Sequence[Mapping[str, float]], jobs: int | None) -> Share:
    """Divide the devices of a cluster among tasks.

    Each task gets one or more GPUs; if there are too few, tasks share them, and their memory.
    Without GPUs a task reserves cores, but JAX computes on all cores of its node.

    Args:
        nodes: the resources of each node, by Ray's names for them, "CPU" and "GPU".
        jobs: number of tasks at a time. None is one per GPU, or one per node if there are no GPUs.

    Returns:
        The share of each task.

    Raises:
        InputError: no node has a GPU or a CPU.

    Example:
        >>> share_of([{"CPU": 16, "GPU": 2}], 4)
        Share(device='GPU', size=0.5, at_once=4, beside=True)
    """
    device = "GPU" if any(node.get("GPU") for node in nodes) else "CPU"
    counts = [int(node[device]) for node in nodes if node.get(device)]
    require(bool(counts), "--cluster: found no node with a GPU or a CPU, expected one")

    def fits(size: int) -> int:
        return sum(count // size for count in counts)

    if jobs is None:
        size = 1 if device == "GPU" else min(counts)
        jobs = fits(size)
    elif jobs <= sum(counts):
        size = max(size for size in range(1, max(counts) + 1) if fits(size) >= jobs)
    else:  # in the ten thousandths that Ray counts in
        size = math.floor(1e4 / math.ceil(jobs / sum(counts))) / 1e4
    beside = size < 1 if device == "GPU" else 2 * size <= max(counts)
    return Share(device, size, jobs, beside)


@contextlib.contextmanager
def joined(
    address: str, jobs: int | None, read: Iterable[str | None], write: pathlib.Path
) -> Iterator[Share]:
    """Join a cluster while the block runs, and yield the share of each task there.

    Args:
        address: "local", "auto", ray://HOST[:PORT] or HOST:PORT, as `cluster.connected` takes it.
        jobs: number of tasks at a time; None is the default of `share_of`.
        read: files and folders; every node must be able to read those that exist here.
        write: a folder that every node must be able to write into.

    Raises:
        InputError: there is no such cluster, a node cannot take part, or no share becomes free.
    """
    names = filter(None, (*read, *loaded_plugins()))
    paths = [os.path.abspath(name) for name in names if os.path.exists(name)]
    with connected(address) as ray:
        check_nodes(ray, read=paths, write=write.absolute())
        share = share_of([node["Resources"] for node in ray.nodes() if node["Alive"]], jobs)
        first = ray.remote(_nothing).options(**_options(share)).remote()
        if not ray.wait([first], timeout=START)[0]:
            raise InputError(
                f"--cluster {address}: found no {share.size:g} free {share.device} within "
                f"{START:.0f} s, expected as much on one node for each run"
            )
        yield share


def in_turn(
    work: Callable[..., Any], shared: tuple[Any, ...], each: Iterable[tuple[Any, ...]] = ((),)
) -> list[Any]:
    """Return `work(*shared, *arguments)` for each tuple of arguments, one call after the other."""
    return [work(*shared, *given) for given in each]


def in_tasks(
    share: Share,
    work: Callable[..., Any],
    shared: tuple[Any, ...],
    each: Iterable[tuple[Any, ...]] = ((),),
) -> list[Any]:
    """Do the work of `in_turn` in Ray tasks; return the results in the order in which they finish.

    Arguments are taken from `each` as tasks start. A task whose worker is lost is started again. On
    a signal, the tasks get Ctrl-C and up to five minutes to save their work; a second signal ends
    the wait. An error in one task ends the others in the same way.

    Raises:
        InputError: a call raised it, or a task lost its worker ten times.
        Interrupted: a signal stopped the work.
    """
    import ray
    from ray.exceptions import RayError, RayTaskError, UnserializableException

    task = ray.remote(_carry_out).options(**_options(share))
    here = os.getcwd(), loaded_plugins()
    reference = [ray.put((work, shared))]  # in a list: a task reads it after loading plug-ins
    waiting, again, lost = iter(each), [], Counter()
    running, results = {}, []
    with defer_signals() as stop:
        stop.has_work = True
        try:
            while True:
                stop.check()
                while len(running) < share.at_once:
                    given = again.pop() if again else next(waiting, None)
                    if given is None:
                        break
                    running[task.remote(*here, reference, given)] = given
                if not running:
                    return results
                for ended in ray.wait([*running], timeout=0.2)[0]:
                    given = running.pop(ended)
                    try:
                        result, notes = ray.get(ended)
                    except (RayTaskError, UnserializableException) as error:
                        raise getattr(error, "cause", error) from error
                    except RayError as error:
                        lost[given] += 1
                        words = f"a worker of the cluster was lost ({type(error).__name__})"
                        if lost[given] == _TRIES:
                            raise InputError(f"{words}, {_TRIES} times in the same work") from None
                        warn(f"{words}; its work resumes from what was saved")
                        again.append(given)
                    else:
                        results.append(result)
                        for note in notes:
                            warn(note)
        finally:
            if running:
                tasks = counted(len(running), "task")
                warn(f"waiting for {tasks} to save the work, at most {_PATIENCE:.0f} s")
            for ended in running:
                ray.cancel(ended)
            ray.wait([*running], num_returns=len(running), timeout=_PATIENCE)


def _options(share: Share) -> dict[str, Any]:
    """Return the Ray options of a task: what it reserves, and its environment variables."""
    values = {name.upper(): getattr(jax.config, name) for name in _JAX}
    values[MAX_PIXELS] = os.environ[MAX_PIXELS]
    if share.device == "GPU" and share.size < 1:
        values["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{_MEMORY * share.size:.3f}"
    given = {name: str(value) for name, value in values.items() if value is not None}
    return {
        **{"num_cpus": 0, f"num_{share.device.lower()}s": share.size},
        **{"max_retries": 0, "scheduling_strategy": "SPREAD", "runtime_env": {"env_vars": given}},
    }


def _nothing() -> None:
    """Start a worker."""


def _carry_out(
    folder: str, plugins: Sequence[str], reference: list[Any], given: tuple[Any, ...]
) -> tuple[Any, list[str]]:
    """Run a call in a worker; return its result and its notes."""
    import ray

    with contextlib.suppress(OSError):  # a node without this folder gets absolute paths
        os.chdir(folder)
    load_plugins(plugins)
    work, shared = ray.get(reference[0])
    result, notes = with_notes(work, *shared, *given)
    return result, [*dict.fromkeys(notes)]
