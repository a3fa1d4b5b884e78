# Sourced by the other scripts: a virtual environment in .venv with the tested versions, made once and kept.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python="${PYTHON:-python3}"
if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))'; then
    echo "python: expected 3.10 or newer, got $("$python" --version 2>&1) from '$python'; set PYTHON to another one" >&2
    exit 2
fi
wanted="$("$python" --version) $(cat pyproject.toml scripts/constraints.txt | cksum)"
if [ "$(cat .venv/tested-set 2>/dev/null || true)" != "$wanted" ]; then
    echo "installing the tested set into .venv (a minute or two; PyTorch is the large part)"
    [ -x .venv/bin/python ] || "$python" -m venv .venv
    .venv/bin/python -m pip install --quiet --constraint scripts/constraints.txt --editable '.[dev]'
    echo "$wanted" >.venv/tested-set
fi
