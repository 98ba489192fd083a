"""Several processes that train one model, each with devices and images of its own."""

import jax
import numpy as np
from jax.experimental import multihost_utils

from crisalad_jax.errors import InputError


def join(coordinator: str, count: int | None = None, number: int | None = None) -> None:
    """Become one of several processes (`jax.distributed`), before JAX is used.

    Args:
        coordinator: host:port at which the first process is reached by the others; "auto" asks the
            cluster that started them (Slurm, Open MPI, Cloud TPU, Kubernetes) for all three.
        count: how many there are.
        number: which one this is, from 0.

    Raises:
        InputError: some of the three are missing, or the processes do not find each other.
    """
    if coordinator == "auto":
        given = {}
    elif count is None or number is None or not 0 <= number < count:
        raise InputError(
            f"coordinator: found {coordinator} with process {number} of {count}, expected all "
            "three, processes counted from 0 (or auto)"
        )
    else:
        given = {
            "coordinator_address": coordinator,
            "num_processes": count,
            "process_id": number,
        }
    try:
        jax.distributed.initialize(**given)
    except (RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"coordinator {coordinator}: {reason}") from error


def leads() -> bool:
    """Whether this process writes the files: the first one does."""
    return jax.process_index() == 0


def meet(where: str) -> None:
    """Wait for the others to come to the same place."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(where)


def leaders(value: float) -> float:
    """The first process's number: one rounded elsewhere might decide otherwise."""
    if jax.process_count() == 1:
        return value
    return float(multihost_utils.broadcast_one_to_all(np.float32(value)))


def any_of(value: bool) -> bool:
    """Whether it is so in one of the processes at least."""
    if jax.process_count() == 1:
        return value
    return bool(np.any(multihost_utils.process_allgather(np.array(value))))
