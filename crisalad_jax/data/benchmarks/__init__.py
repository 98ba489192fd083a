"""Readers of evaluation sets, one module for each layout on disk (see docs/datasets.md)."""

from crisalad_jax.data.benchmarks.benchmark import Benchmark
from crisalad_jax.data.benchmarks.folders import read_folders
from crisalad_jax.data.benchmarks.msls import read_msls
from crisalad_jax.data.benchmarks.netvlad import read_netvlad
from crisalad_jax.data.benchmarks.npy_lists import read_salad_lists, read_vpr_bench
from crisalad_jax.data.benchmarks.open import LAYOUTS, open_benchmark
from crisalad_jax.data.benchmarks.utm import read_utm

__all__ = [
    "LAYOUTS",
    "Benchmark",
    "open_benchmark",
    "read_folders",
    "read_msls",
    "read_netvlad",
    "read_salad_lists",
    "read_utm",
    "read_vpr_bench",
]
