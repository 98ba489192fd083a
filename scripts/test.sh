#!/usr/bin/env bash
# Sets up what is missing, then runs the linters, the type checker and the tests.
set -euo pipefail
cd "$(dirname "$0")/.."
source scripts/environment.sh "[dev]"
ruff check .
ruff format --check .
pyright
# Checks the import direction between the subpackages (pyproject.toml).
lint-imports
# Both cores have a worker, so each program is compiled in one piece: 134 -> 122 to 130 s for four files.
# Most of the time is compilation, and programs that run for milliseconds need no optimisation. XLA's newer
# emitters take twice as long to compile a training step: 17 to 24 s of a core, and 8 to 10 s without them.
# The XLA of jax 0.12 has only the newer ones, and aborts on an unknown flag.
flags="--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
case "$(python -m pip show jax)" in *"Version: 0.10."*) flags+=" --xla_cpu_use_fusion_emitters=false" ;; esac
export XLA_FLAGS="$flags ${XLA_FLAGS:-}"
unset PYTHONDONTWRITEBYTECODE # otherwise each of hundreds of processes byte-compiles the package: 0.8 s
# Two workers, because much of the time is single-threaded compilation. The order is that of conftest.py.
exec python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow" "$@"
