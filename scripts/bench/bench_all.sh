#!/usr/bin/env bash
# Sets up what is missing, then times this package, torch and other engines, on an otherwise idle machine.
#
#     bench_all.sh               all tables and plots of docs/performance, docs/training and docs/search: hours
#     bench_all.sh --processor   only descriptors, training steps, products and queries, for a
#                                processor that is not in docs/performance: an hour or more on two cores
#     bench_all.sh --gpu         on a GPU that both torch and jax find, into docs/performance-gpu: 15 minutes (estimate)
#
# --processor and --gpu replace the existing tables. --small after one of them is a trial with small sizes,
# also on a CPU, that writes the tables to a temporary folder.
# Further flags are passed to the benches of descriptors and training steps, for example
#     --presets b14 --batches 256 --dtypes bfloat16
set -euo pipefail
cd "$(dirname "$0")/../.."
mode=all
case "${1:-}" in --processor | --gpu) mode=${1#--}; shift ;; esac
small=
if [ "${1:-}" = --small ] && [ $mode != all ]; then small=1; shift; fi
source scripts/environment.sh "[dev,bench]"
bench() { python "scripts/bench/bench_$1.py" "${@:2}"; }
if [ "$mode" = gpu ]; then
  to=(--out docs/performance-gpu)
  [ -z "$small" ] || to=(--out "$(mktemp -d)")
  describe=(--presets b14 --batches 1 64 256 --dtypes float32 bfloat16) train=(--presets b14 --batches 192 --dtypes float32 bfloat16)
  folder=(--presets b14 --images 4000 --batch 256) memory=(--preset b14 --images 192) sinkhorn=()
  if [ "$small" ]; then
    describe=(--presets tiny --batches 8 --rounds 1) train=("${describe[@]}")
    folder=(--presets tiny --images 40 --batch 8 --rounds 1) memory=(--preset tiny --images 8 --micro-batches 4)
    sinkhorn=(--images 2 --patches 64 --clusters 8 --iterations 3 --errors 1e-2 --rounds 1 --calls 2 --batches 1)
  fi
  bench describe "${to[@]}" "${describe[@]}" "$@"
  bench train "${to[@]}" "${train[@]}" "$@"
  bench sinkhorn "${to[@]}" "${sinkhorn[@]}"
  bench extract "${to[@]}" "${folder[@]}"
  bench memory "${to[@]}" "${memory[@]}"
  exit
fi
to=()
if [ "$mode" = processor ]; then
  describe=(--presets tiny s14 b14 resnet50 --batches 1 8 --dtypes float32 bfloat16)
  train=(--presets tiny s14 b14 --batches 8 --dtypes float32 bfloat16) start=()
  if [ "$small" ]; then
    to=(--out "$(mktemp -d)") describe=(--presets tiny --batches 1 8 --rounds 1)
    train=(--presets tiny --batches 8 --rounds 1) start=(--preset tiny --rounds 1)
  fi
  bench describe "${to[@]}" "${describe[@]}" "$@"
  bench train "${to[@]}" "${train[@]}" "$@"
  bench modes "${to[@]}" bench_products
  bench query "${to[@]}" "${start[@]}"
  bench locate "${to[@]}" "${start[@]}"
  exit
fi
bench describe "$@"
bench published
bench train "$@"
bench extract
bench start
bench query
bench locate
bench scale
bench modes
bench profile
bench index
bench loader
bench overlap
bench memory --take
# A million descriptors take 34 GB in the folder for temporary files.
bench search
