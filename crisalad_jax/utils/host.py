"""The share of the machine that this process may use."""

import contextlib
import functools
import os
import pathlib
import re
import resource


def usable_cores() -> int:
    """Count the cores that this process may use, if the system reports that; else all cores."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@functools.cache
def processor_flags() -> frozenset[str]:
    """Return the processor's feature flags, as Linux lists them; empty on other systems."""
    with contextlib.suppress(OSError):
        lines = pathlib.Path("/proc/cpuinfo").read_text(encoding="utf-8")
        found = re.search(r"^flags\s*:(.*)$", lines, re.MULTILINE)
        return frozenset(found[1].split() if found else ())
    return frozenset()


def available_memory() -> int:
    """Return the bytes of memory that programs can still use, or an upper bound if unknown."""
    found = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    with contextlib.suppress(OSError):
        lines = pathlib.Path("/proc/meminfo").read_text(encoding="utf-8")
        found += [1024 * int(size) for size in re.findall(r"MemAvailable:\s*(\d+) kB", lines)]
    with contextlib.suppress(OSError, ValueError):  # a container's limit, or "max"
        found.append(int(pathlib.Path("/sys/fs/cgroup/memory.max").read_text(encoding="utf-8")))
    return min(found)


def most_files() -> int:
    """Return how many files, including connections, this process may have open at once."""
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return 2**20 if files == resource.RLIM_INFINITY else files
