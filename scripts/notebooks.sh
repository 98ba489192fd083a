#!/usr/bin/env bash
# Runs the notebooks of the documentation again, on a demo, and stores their output.
#
#     bash scripts/notebooks.sh [DEMO]
#
# DEMO is a folder made by `crisalad demo`; without it, one is made, which takes minutes.
set -euo pipefail
demo=${1:+$(realpath "$1")}
cd "$(dirname "$0")/.."
source scripts/environment.sh "[dev]"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
if [ -n "$demo" ]; then
  cp -r "$demo" "$work/demo"
else
  crisalad demo --out "$work/demo"
fi
cp docs/notebooks/*.ipynb "$work"
python - "$work"/*.ipynb <<'END'
import pathlib
import sys

import nbclient
import nbformat

for name in sys.argv[1:]:
    print(name, file=sys.stderr)
    book = nbformat.read(name, as_version=4)
    nbclient.NotebookClient(
        book,
        timeout=None,
        record_timing=False,
        coalesce_streams=True,
        resources={"metadata": {"path": str(pathlib.Path(name).parent)}},
    ).execute()
    nbformat.write(book, name)
END
cp "$work"/*.ipynb docs/notebooks/
