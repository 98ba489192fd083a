#!/usr/bin/env bash
# Sets up what is missing and rebuilds the packaged model: renders 24,000 places, trains on them
# three times, and whitens. It takes about four hours on two cores; the same command resumes.
set -euo pipefail
usage="usage: bash scripts/starter.sh [OUT [VAL]]"
case "${1:-}" in -h | --help) echo "$usage"; exit ;; esac
[ $# -le 2 ] || { echo "found $# arguments, expected at most 2; $usage" >&2; exit 2; }
[ $# -lt 2 ] || [ -d "$2" ] || { echo "$2: found no such folder; $usage" >&2; exit 2; }
out="$(realpath -m -- "${1:-starter}")"
# VAL selects the best epoch: a set of photographs, or by default rendered places not trained on.
val="$(realpath -m -- "${2:-$out/world/test}")"
cd "$(dirname "$0")/.."
source scripts/environment.sh "[all]"
[ -f "$out/world/set.json" ] || crisalad render --out "$out/world" --scenes 6000 --image-size 144 192
train() { crisalad train --data "$out/world/train" --val "$val" "$@"; }
train --config docs/starter/first.json --out "$out/first"
train --config docs/starter/config.json --weights "$out/first/best.safetensors" --out "$out/run"
train --config docs/starter/third.json --weights "$out/run/best.safetensors" --out "$out/third"
python scripts/starter.py "$out/third/last.safetensors" "$out/world/train"
