#!/usr/bin/env bash
# Sets up what is missing, then times descriptors and training beside torch and writes the tables and
# pictures of docs/performance.md. For figures that mean something, on a machine with nothing else to
# do. Flags go to both, such as --presets b14 --batches 256 --dtype bfloat16.
set -euo pipefail
cd "$(dirname "$0")/.."
source scripts/environment.sh "[dev]"
python scripts/bench_describe.py --page docs/performance.md "$@"
python scripts/bench_train.py --page docs/performance.md "$@"
