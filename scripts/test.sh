#!/usr/bin/env bash
# Sets up what is missing, then runs the linters, the type checker and the tests.
set -euo pipefail
cd "$(dirname "$0")/.."
source scripts/environment.sh "[dev]"
ruff check .
ruff format --check .
pyright
# One import direction between the rooms of the package (pyproject.toml).
lint-imports
# Both cores have a worker, so a program is compiled in one piece: 134 -> 122 to 130 s of four files.
# Most of the time is XLA's, which need not optimise programs that run for milliseconds. Its newer
# emitters take twice as long to compile a training step: 17 to 24 s of a core, and 8 to 10 without.
# XLA of jax 0.12 has no others, and ends at a flag that it does not know.
flags="--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
case "$(python -m pip show jax)" in *"Version: 0.10."*) flags+=" --xla_cpu_use_fusion_emitters=false" ;; esac
export XLA_FLAGS="$flags ${XLA_FLAGS:-}"
unset PYTHONDONTWRITEBYTECODE # or each of the hundreds of programs compiles the package again: 0.8 s
# Two workers: much of the time is compiling, which one core does. In the order of conftest.py.
exec python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow" "$@"
