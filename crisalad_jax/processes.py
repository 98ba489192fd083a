"""One training run in several processes, of one host or of many (`jax.distributed`).

All run the same program. Process 0 leads: it alone reads and writes the folder of the run.
"""

import json
import re
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

from crisalad_jax.errors import InputError, Stopped

_MESSAGE = 2**16
"""Bytes of what `led` tells, always as many: another size would be another program."""
_T = TypeVar("_T")


def join(coordinator: str, count: int | None, index: int | None) -> None:
    """Become one of several processes, before JAX is used for anything else.

    A CPU is one device in each: of several, whose threads wait for other processes, all may come to
    wait for ever.

    Args:
        coordinator: HOST:PORT of process 0, where all can reach it; or "auto" under what JAX knows
            to ask (Slurm, Open MPI, Kubernetes, Cloud TPU), for the other two as well.
        count: how many there are.
        index: which this is, from 0.

    Raises:
        InputError: the three do not fit each other, or the others cannot be met.
    """
    if coordinator == "auto":
        if (count, index) != (None, None):
            raise InputError("processes: found auto and a number, expected auto alone")
        given: dict[str, Any] = {}
    elif (
        count is None
        or index is None
        or not 0 <= index < count
        or not re.fullmatch(r".+:\d+", coordinator)
    ):
        raise InputError(
            f"processes: found process {index} of {count} with {coordinator}, expected "
            "--coordinator HOST:PORT --processes COUNT --process INDEX, with an index from 0 and "
            "below the count"
        )
    else:
        given = {"num_processes": count, "process_id": index, "coordinator_address": coordinator}
        # Or a scheduler that JAX knows would be asked which devices this process has.
        given["cluster_detection_method"] = "deactivate"
    jax.config.update("jax_num_cpu_devices", 1)
    # JAX's own handler of SIGTERM would keep it from this program.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(**given)
    except (ValueError, RuntimeError) as error:
        raise InputError(f"processes: cannot meet the others: {error}") from error


def leads() -> bool:
    """Whether this process is the one that reads and writes the run's folder."""
    return jax.process_index() == 0


def led(work: Callable[[], _T]) -> _T:
    """What `work`, done by the leader alone, returns: the same, a JSON value, in every process.

    Raises:
        InputError, Stopped: in every process, where `work` raises it.
    """
    if jax.process_count() == 1:
        return work()
    said: dict[str, Any] = {"error": "it failed"}
    value = None
    try:
        if leads():
            value = work()
            said = {"value": value}
    except Stopped as stopped:
        said = {"stopped": stopped.number}
        raise
    except (InputError, OSError) as error:
        said = {"error": str(error)}
        raise
    finally:
        heard = _hear(said)
    if leads():
        return value  # pyright: ignore[reportReturnType]
    if "stopped" in heard:
        raise Stopped(heard["stopped"])
    if "error" in heard:
        raise InputError(f"process 0: {heard['error']}")
    return heard["value"]


def _hear(said: dict[str, Any]) -> dict[str, Any]:
    """What the leader says."""
    message = json.dumps(said).encode()
    if len(message) > _MESSAGE:
        raise ValueError(f"found a message of {len(message)} bytes, expected at most {_MESSAGE}")
    padded = np.frombuffer(message.ljust(_MESSAGE), np.uint8)
    heard = np.asarray(multihost_utils.broadcast_one_to_all(padded), np.uint8)
    return json.loads(heard.tobytes())


def handed_out(tree: _T) -> _T:
    """The leader's arrays in every process; the others give arrays of the same shapes."""
    return tree if jax.process_count() == 1 else multihost_utils.broadcast_one_to_all(tree)


def largest(number: int) -> int:
    """Of the numbers below 2**32 that the processes give."""
    return max(_gathered(number))


def check_same(name: str, number: int) -> None:
    """Check that all processes give the same number for what is named.

    Raises:
        InputError: they do not, in every process.
    """
    found = _gathered(number)
    others = [process for process, one in enumerate(found) if one != found[0]]
    if others:
        raise InputError(
            f"processes: found other {name} in process {others[0]} than in 0, expected the same"
        )


def _gathered(number: int) -> list[int]:
    if jax.process_count() == 1:
        return [number]
    return multihost_utils.process_allgather(np.uint32(number)).tolist()


def together(items: Iterable[_T]) -> Iterator[_T]:
    """The items, each `agreed`."""
    stream = iter(items)
    while (item := agreed(lambda: next(stream, None))) is not None:
        yield item


def agreed(work: Callable[[], _T]) -> _T:
    """What `work` returns, where it fails in no process: as nobody is to wait for one that has.

    Raises:
        InputError: it failed in another process. In that one, its own error.
    """
    error, value = None, None
    try:
        value = work()
    except Exception as raised:
        error = raised
    failed = largest(error is not None)
    if error is not None:
        raise error
    if failed:
        raise InputError("processes: another one failed; see what it says")
    return value  # pyright: ignore[reportReturnType]
