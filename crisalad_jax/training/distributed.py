"""Coordinate one training run in several processes, on one host or many (`jax.distributed`).

All processes run the same program. Process 0 is the primary: only it reads and writes the run's
folder.
"""

import json
import os
import re
import socket
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

from crisalad_jax.config.checks import require
from crisalad_jax.training.lost import HEARTBEAT
from crisalad_jax.utils.errors import InputError, Interrupted

_MESSAGE = 2**16
"""Number of bytes that `run_on_primary` broadcasts: fixed, because JAX compiles for each size."""
_T = TypeVar("_T")


def join_processes(
    coordinator: str,
    count: int | None,
    index: int | None,
    local_device_ids: Sequence[int] | None = None,
) -> None:
    """Join a group of processes, before JAX is used for anything else.

    On CPUs, each process has one device: with several, threads that wait for other processes could
    deadlock the group. With GPUs, each process of a host has one by default (`local_device_ids`).

    Args:
        coordinator: HOST:PORT of process 0, reachable from all; or "auto" if JAX can read
            this, `count` and `index` from the environment (Slurm, Open MPI, Kubernetes, Cloud TPU).
        count: number of processes; None with "auto".
        index: number of this process, from 0; None with "auto".
        local_device_ids: numbers of this process's GPUs on its host. None is the number of the
            process on its host, if a launcher (Slurm, Open MPI) or "auto" gives it, or if all
            processes are on one host (a coordinator at localhost). Otherwise, or if the process
            sees only one GPU, it is all GPUs that the process sees.

    Raises:
        InputError: the arguments do not fit together, or other processes cannot be reached.
    """
    is_valid = count is None and index is None
    if coordinator != "auto":
        fits = count is not None and index is not None and 0 <= index < count
        port = re.fullmatch(r".+:(\d{1,5})", coordinator)
        is_valid = fits and port is not None and 0 < int(port[1]) < 2**16
    require(
        is_valid,
        f"processes: found process {index} of {count} with {coordinator}, expected "
        "--coordinator-address HOST:PORT --num-processes COUNT --process-id INDEX, with a port of "
        "1 to 65535, and an index from 0 and below the count; or only auto",
    )
    given: dict[str, Any] = {}
    if coordinator != "auto":
        given = {"num_processes": count, "process_id": index, "coordinator_address": coordinator}
        # Otherwise JAX would ask the scheduler which devices this process has.
        given["cluster_detection_method"] = "deactivate"
        if local_device_ids is None and index is not None:
            local_device_ids = _own_device(coordinator, index)
        if index == 0:
            _check_port(coordinator)
    if local_device_ids is not None:
        require(
            len(local_device_ids) > 0 and min(local_device_ids) >= 0,
            f"--local-device-ids: found {tuple(local_device_ids)}, expected numbers of this host's "
            "GPUs, from 0",
        )
        given["local_device_ids"] = list(local_device_ids)
    jax.config.update("jax_num_cpu_devices", 1)
    # JAX's own SIGTERM handler would hide the signal from this program.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(**given, heartbeat_timeout_seconds=HEARTBEAT)
    except (ValueError, RuntimeError) as error:
        raise InputError(
            f"processes: cannot join the others at --coordinator-address {coordinator}: {error} "
            "(auto needs Slurm, Open MPI, Kubernetes or a Cloud TPU)"
        ) from error


_LAUNCHED = (
    ("SLURM_PROCID", "SLURM_LOCALID"),
    ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_LOCAL_RANK"),
)
"""Environment variables with a process's number among all and on its host: Slurm, Open MPI."""
_VISIBLE = ("CUDA_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES")
"""Environment variables with the GPUs that a process sees."""


def _own_device(coordinator: str, index: int) -> list[int] | None:
    """Return the number of this process's own GPU; None if it cannot be determined.

    Without it, each process would claim the memory of all GPUs of its host.
    """
    if os.environ.get("JAX_LOCAL_DEVICE_IDS"):
        return None  # JAX reads it
    if any(len(os.environ[name].split(",")) == 1 for name in _VISIBLE if os.environ.get(name)):
        return None  # it was assigned a GPU, which has the number 0 here
    host = coordinator.rpartition(":")[0].strip("[]")
    if host in ("localhost", "::1") or host.startswith("127."):
        return [index]
    for number, local in _LAUNCHED:
        # A shell started by the launcher has numbers too, which are not those of its processes.
        if os.environ.get(number) == str(index) and os.environ.get(local, "").isdecimal():
            return [int(os.environ[local])]
    return None


def _check_port(address: str) -> None:
    """Check that process 0 can listen at this address; otherwise JAX would exit without a message.

    Raises:
        InputError: it cannot listen there.
    """
    host, _, port = address.rpartition(":")
    try:
        socket.getaddrinfo(host.strip("[]"), None)  # JAX would wait minutes for an unknown host
        # JAX listens at this port on all interfaces.
        with socket.socket(socket.AF_INET) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(("", int(port)))
    except (OSError, OverflowError, UnicodeError) as error:
        raise InputError(
            f"--coordinator-address: found {address}, where this process cannot listen "
            f"({getattr(error, 'strerror', None) or error}), expected this host and a free port"
        ) from error


def is_primary() -> bool:
    """Return whether this process is the one that reads and writes the run's folder."""
    return jax.process_index() == 0


def run_on_primary(work: Callable[[], _T]) -> _T:
    """Run `work` only in the primary process; return its result, a JSON value, in every process.

    Raises:
        InputError, Interrupted: `work` has failed; all processes raise, as in `raise_together`.
    """
    value: Any = raise_together(lambda: work() if is_primary() else None)
    if jax.process_count() == 1:
        return value
    text = json.dumps(value).encode()
    assert len(text) <= _MESSAGE
    padded = np.frombuffer(text.ljust(_MESSAGE), np.uint8)
    received = np.asarray(multihost_utils.broadcast_one_to_all(padded), np.uint8)
    return json.loads(received.tobytes())


def broadcast(tree: _T) -> _T:
    """Return the primary process's arrays in every process; all pass arrays of the same shapes."""
    return tree if jax.process_count() == 1 else multihost_utils.broadcast_one_to_all(tree)


def all_max(*numbers: int) -> tuple[int, ...]:
    """Return the maximum of each number over all processes; numbers are 0 to 2**32 - 1."""
    return tuple(_gather(*numbers).max(axis=0).tolist())


def check_same(numbers: Mapping[str, int]) -> None:
    """Check that all processes pass the same numbers, named for messages.

    Raises:
        InputError: a number differs between processes; every process raises the error.
    """
    gathered = _gather(*numbers.values())
    is_other = gathered != gathered[0]
    if is_other.any():
        position = is_other.any(axis=0).argmax()
        which = np.flatnonzero(is_other[:, position]).tolist()
        where = f"process{'es' * (len(which) > 1)} {', '.join(map(str, which))}"
        raise InputError(
            f"processes: found other {list(numbers)[position]} in {where} than in 0, expected the "
            "same"
        )


def _gather(*numbers: int) -> np.ndarray:
    mine = np.asarray(numbers, np.uint32)
    if jax.process_count() == 1:
        return mine[None]
    return np.asarray(multihost_utils.process_allgather(mine))


def raise_together(work: Callable[[], _T]) -> _T:
    """Run `work` in every process and return its value; raise in all if it fails in one.

    Raises:
        Interrupted: a signal has ended `work`, here or in another process.
        InputError: `work` has failed in another process, which raises its own error.
    """
    error, value, code = None, None, 0
    try:
        value = work()
    except Exception as raised:
        error, code = raised, 1
        if isinstance(raised, Interrupted):
            code += raised.number
    failed, where = all_max(code, jax.process_index() if code else 0)
    if error is not None:
        raise error
    if failed > 1:
        raise Interrupted(failed - 1)
    if failed:
        raise failed_elsewhere(where)
    return value  # pyright: ignore[reportReturnType]


def failed_elsewhere(process: int) -> InputError:
    """Make the error that all processes but the failed one raise."""
    return InputError(f"processes: process {process} failed; see what it says")
