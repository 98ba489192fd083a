"""How much of the machine is ours."""

import os


def usable_cores() -> int:
    """Cores that this process may use, where the system says; or all."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
