"""The images of an evaluation set that can be read."""

import pathlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from crisalad_jax.data.benchmarks.benchmark import Benchmark
from crisalad_jax.data.images import read_image
from crisalad_jax.data.loader import THREADS
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.progress import progress_bar


def leave_out_unreadable(benchmark: Benchmark, *, quiet: bool = False) -> Benchmark:
    """Read all images of a set, and return it without those that cannot be read.

    Args:
        benchmark: the set.
        quiet: whether to show no progress bar.

    Raises:
        InputError: what `Benchmark.of_readable` raises.
    """
    paths = (*benchmark.queries, *benchmark.database)
    readable = np.empty(len(paths), bool)
    with (
        progress_bar("reading", len(paths), "images", quiet=quiet) as bar,
        ThreadPoolExecutor(THREADS) as pool,
    ):
        for number, whole in enumerate(pool.map(_is_readable, paths)):
            readable[number] = whole
            bar.advance(1)
    asked = len(benchmark.queries)
    return benchmark.of_readable(readable[:asked], readable[asked:])


def _is_readable(path: pathlib.Path) -> bool:
    try:
        read_image(path)
    except InputError:
        return False
    return True
