"""Readers of evaluation sets, one module for each layout on disk (see docs/datasets.md)."""

from crisalad_jax.data.benchmarks.benchmark import Benchmark as Benchmark
from crisalad_jax.data.benchmarks.folders import read_folders as read_folders
from crisalad_jax.data.benchmarks.msls import read_msls as read_msls
from crisalad_jax.data.benchmarks.netvlad import read_netvlad as read_netvlad
from crisalad_jax.data.benchmarks.npy_lists import read_salad_lists as read_salad_lists
from crisalad_jax.data.benchmarks.npy_lists import read_vpr_bench as read_vpr_bench
from crisalad_jax.data.benchmarks.open import LAYOUTS as LAYOUTS
from crisalad_jax.data.benchmarks.open import open_benchmark as open_benchmark
from crisalad_jax.data.benchmarks.utm import read_utm as read_utm
