#!/usr/bin/env bash
# Compiles b14 for accelerators that are not here, which takes two cores an hour or so, and puts the
# figures into docs/accelerators/ and its page. In an environment of its own: `pip install -e .[train]
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
