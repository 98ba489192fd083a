#!/usr/bin/env bash
# Sets up what is missing and runs the demo. It needs no data and no accelerator.
set -euo pipefail
cd "$(dirname "$0")/.."
source scripts/environment.sh "[all]"
exec crisalad demo --out demo "$@"
