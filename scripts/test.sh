#!/usr/bin/env bash
# Check style and run the whole test suite on the CPU, in the tested environment.  bash scripts/test.sh [pytest options]
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
.venv/bin/ruff check .
.venv/bin/ruff format --check .
export OMP_NUM_THREADS=1 # tests are many and small: one thread each, on two processes
.venv/bin/python -m pytest --numprocesses 2 "$@"
