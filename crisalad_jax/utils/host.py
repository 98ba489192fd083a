"""The share of the machine that this process may use."""

import os
import resource


def usable_cores() -> int:
    """Count the cores that this process may use, where the system tells; else all cores."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def most_files() -> int:
    """Return how many files this process may have open, connections among them."""
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return 2**20 if files == resource.RLIM_INFINITY else files
