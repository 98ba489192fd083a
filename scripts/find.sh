#!/usr/bin/env bash
# Sets up what is missing, makes a map of a folder of photographs, and queries it with one of them or
# with another. Without a folder it renders some places to try it on. It downloads no weights.
set -euo pipefail
usage="usage: bash scripts/find.sh [FOLDER [PHOTOGRAPH]]"
stop() { echo "$1; $usage" >&2; exit 2; }
case "${1:-}" in -h | --help) echo "$usage"; exit ;; esac
[ $# -le 2 ] || stop "found $# arguments, expected at most 2"
[ $# -lt 1 ] || [ -d "$1" ] || stop "$1: found no such folder"
[ $# -lt 2 ] || [ -e "$2" ] || stop "$2: found no such photograph"
photograph=""
[ $# -lt 1 ] || images="$(realpath -- "$1")"
[ $# -lt 2 ] || photograph="$(realpath -- "$2")"
cd "$(dirname "$0")/.."
source scripts/environment.sh "[maps,report]"
if [ $# -eq 0 ]; then
  echo "No folder given: rendering 96 places to try it on. $usage" >&2
  crisalad render --out found/world --scenes 1 --test-scenes 24
  images="$PWD/found/world/test/images/test/database"
  photograph="$PWD/found/world/test/images/test/queries"
fi
# One map for each folder, even if two have the same name, and for each version of the model.
key="$(cat crisalad_jax/checkpoints/starter.safetensors - <<<"$images" | cksum | cut -d " " -f 1)"
map="$PWD/found/$(basename -- "$images")-$key.map"
crisalad index --images "$images" --out "$map" --on-bad-image skip
if [ -z "$photograph" ]; then
  echo "No photograph given: querying with the first of the folder, which will find itself first." >&2
  photograph="$(python -c 'import sys
from crisalad_jax.retrieval.maps.map import Map
with Map.open(sys.argv[2]) as places:
    print(sys.argv[1], places.images[0].name, sep="/")' "$images" "$map")"
fi
crisalad query "$photograph" --map "$map" --gallery "$PWD/found/answers.png"
