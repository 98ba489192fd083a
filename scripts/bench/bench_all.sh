#!/usr/bin/env bash
# Sets up what is missing, then times descriptors and training beside torch and other engines, a folder of photographs
# from end to end, the start of a program, and bfloat16 beside float32, and says where our time goes;
# then what training at the paper's size takes, and search. Writes the tables and pictures of
# docs/performance.md, docs/training.md and docs/search.md. For figures that mean something, on a
# machine with nothing else to do. Flags go to the first two, such as
#     --presets b14 --batches 256 --dtypes bfloat16
set -euo pipefail
cd "$(dirname "$0")/../.."
source scripts/environment.sh "[dev,bench]"
page=(--page docs/performance.md)
python scripts/bench/bench_describe.py "${page[@]}" "$@"
python scripts/bench/bench_published.py "${page[@]}"
python scripts/bench/bench_train.py "${page[@]}" "$@"
python scripts/bench/bench_extract.py "${page[@]}"
python scripts/bench/bench_start.py "${page[@]}"
python scripts/bench/bench_query.py "${page[@]}"
python scripts/bench/bench_modes.py "${page[@]}"
python scripts/bench/bench_profile.py "${page[@]}"
page=(--page docs/training.md)
python scripts/bench/bench_index.py "${page[@]}"
python scripts/bench/bench_loader.py "${page[@]}"
python scripts/bench/bench_overlap.py "${page[@]}"
python scripts/bench/bench_memory.py "${page[@]}" --take
# A million descriptors take 34 GB of the folder for temporary files.
python scripts/bench/bench_search.py --page docs/search.md
