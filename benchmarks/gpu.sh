#!/usr/bin/env bash
# All that a GPU can show of this package, in under nine minutes, without a network:
#
#     benchmarks/gpu.sh [FOLDER]        FOLDER (default: outputs/gpu) gets tests.txt, *.json and table.md
#
# PYTHON=... the interpreter in which the package is installed, with pytest. A part that fails leaves the others alone, and
# the exit code is not zero.
set -uo pipefail
cd "$(dirname "$0")/.."
folder=${1:-outputs/gpu}
python=${PYTHON:-python3}
mkdir -p "$folder"
failed=0
timeout 150 "$python" -m pytest -q -p no:cacheprovider -p no:warnings tests -k "cuda or gpu" -x --maxfail 20 \
    2>&1 | tee "$folder/tests.txt" || failed=1
timeout 60 "$python" benchmarks/hash_grid.py --json "$folder/hash-grid.json" | tee "$folder/table.md" || failed=1
timeout 330 "$python" benchmarks/gpu.py --json "$folder/gpu.json" | tee -a "$folder/table.md" || failed=1
exit $failed
