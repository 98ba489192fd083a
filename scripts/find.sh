#!/usr/bin/env bash
# Sets up what is missing, makes a map of a folder of photographs, and asks it about one of them or
# about another. Without a folder it draws some places to try it on. No weights to download.
set -euo pipefail
usage="usage: bash scripts/find.sh [FOLDER [PHOTOGRAPH]]"
[ $# -le 2 ] || { echo "$usage" >&2; exit 2; }
for path in "$@"; do
  [ -e "$path" ] || { echo "$path: found no such file or folder; $usage" >&2; exit 2; }
done
[ $# -eq 0 ] || images="$(realpath "$1")"
[ $# -lt 2 ] || photograph="$(realpath "$2")"
cd "$(dirname "$0")/.."
source scripts/environment.sh "[maps]"
if [ $# -eq 0 ]; then
  echo "No folder given: drawing 96 places to try it on. $usage" >&2
  crisalad render --out found/world --scenes 1 --test-scenes 24
  images=found/world/test/images/test/database
  photograph=found/world/test/images/test/queries
fi
map="found/$(basename "$images").map"
crisalad index --images "$images" --out "$map"
if [ $# -eq 1 ]; then
  photograph="$(find "$images" -type f \( -iname '*.jpg' -o -iname '*.jpeg' -o -iname '*.png' \) -print -quit)"
fi
crisalad query "$photograph" --map "$map" --gallery found/answers.png
