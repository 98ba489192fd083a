#!/usr/bin/env bash
# Sets up what is missing and makes the model in the package again: renders 24,000 places, trains
# on them three times, and whitens. About four hours on two cores; the same command resumes.
set -euo pipefail
usage="usage: bash scripts/starter.sh [OUT [VAL]]"
case "${1:-}" in -h | --help) echo "$usage"; exit ;; esac
[ $# -le 2 ] || { echo "found $# arguments, expected at most 2; $usage" >&2; exit 2; }
[ $# -lt 2 ] || [ -d "$2" ] || { echo "$2: found no such folder; $usage" >&2; exit 2; }
out="$(realpath -m -- "${1:-starter}")"
# A set of photographs chooses the best epoch, or places of the world that were not trained on.
val="$(realpath -m -- "${2:-$out/world/test}")"
cd "$(dirname "$0")/.."
source scripts/environment.sh "[all]"
[ -f "$out/world/set.json" ] || crisalad render --out "$out/world" --scenes 6000 --image-size 144 192
train() { crisalad train --data "$out/world/train" --val "$val" "$@"; }
train --config docs/starter/first.json --out "$out/first"
train --config docs/starter/config.json --weights "$out/first/best.safetensors" --out "$out/run"
train --config docs/starter/third.json --weights "$out/run/best.safetensors" --out "$out/third"
python scripts/starter.py "$out/third/last.safetensors" "$out/world/train"
