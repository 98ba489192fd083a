#!/usr/bin/env bash
# Compiles b14 for absent accelerators, which takes about an hour on two cores, and writes the figures
# and their page to docs/accelerators/. Use a separate environment: `pip install -e .[train]
# -r scripts/bench/compile_check.txt`.
set -euo pipefail
cd "$(dirname "$0")/../.."
export JAX_PLATFORMS=cpu
check() {
  python -m scripts.compile_check --model.compute-dtype bfloat16 "$@"
}
check --targets h100 h100-8 v5e-1 v5e-8 v6e-8 v5e-64 --json docs/accelerators/compile_check.json
check --targets v5e-64 --programs train --batch-size 1536 --json docs/accelerators/grown-64.json
check --targets v5e-256 --programs train --batch-size 6144 --json docs/accelerators/grown-256.json
python scripts/bench/compile_check_page.py
