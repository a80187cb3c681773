#!/bin/sh
# Create or refresh .venv from the hash-locked requirements. `make` runs this; run it by hand as
#   sh tools/setup_venv.sh          build .venv (PYTHON=/path/to/python chooses the interpreter)
#   sh tools/setup_venv.sh check    exit 0 if .venv is complete and belongs to this checkout, these locks and $PYTHON
#
# .venv/.ready is written last and holds what .venv was made from, so an interrupted set-up, a changed lock
# or pyproject.toml, a moved or copied checkout and another PYTHON are all noticed.
set -eu
trap 'exit 130' INT
trap 'exit 143' TERM
unset CDPATH
cd -- "$(dirname -- "$0")/.."
unset PYTHONPATH PYTHONHOME PIP_TARGET PIP_PREFIX
export PIP_USER=0 PIP_DISABLE_PIP_VERSION_CHECK=1

ready=.venv/.ready
lock=requirements/dev.lock
installer=requirements/installer.lock
python=.venv/bin/python

say() { printf 'setup: %s\n' "$*"; }
die() { printf 'setup: error: %s\n' "$*" >&2; exit 1; }

# Line 1: the inputs; line 2: the checkout; line 3 (added by identity): the interpreter.
inputs() { cat "$lock" "$installer" pyproject.toml tools/setup_venv.sh | cksum; }
identity() { "$1" -c 'import sys; print(*sys.version_info[:3], sys.base_prefix)' 2>/dev/null; }
stamp() { inputs; pwd -P; identity "$python"; }
usable() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; }
# The requested interpreter, if any, is the one .venv was made with.
same_python() { [ -z "${PYTHON:-}" ] || [ "$(identity "$PYTHON")" = "$(identity "$python")" ]; }

if [ "${1:-}" = check ]; then
    [ -f "$ready" ] && [ "$(stamp)" = "$(cat "$ready")" ] && same_python
    exit
fi

# 1. An interpreter. Each candidate is run, not just looked up: version-manager shims may exist and fail.
if [ -n "${PYTHON:-}" ]; then
    usable "$PYTHON" || die "PYTHON=$PYTHON does not run or is older than Python 3.11"
    chosen=$PYTHON
else
    chosen=
    for candidate in python3.11 python3.12 python3.13 python3; do
        if usable "$candidate"; then chosen=$candidate; break; fi
    done
    [ -n "$chosen" ] || die "Python 3.11 or newer is needed and none was found; try: make PYTHON=/path/to/python3.11"
fi

# 2. The environment. A complete one of this checkout is refreshed in place; anything else is replaced.
if [ -f "$ready" ] && same_python && [ "$(sed 1d "$ready")" = "$(stamp | sed 1d)" ]; then
    say "the requirements changed: refreshing .venv"
    rm -f "$ready"
else
    rm -f "$ready"
    say "creating .venv with $chosen ($("$chosen" -c 'import platform; print(platform.python_version())'))"
    "$chosen" -c 'import venv, ensurepip' 2>/dev/null ||
        die "$chosen lacks venv or ensurepip (on Debian and Ubuntu: apt install python3-venv)"
    "$chosen" -m venv --clear .venv
fi

# 3. The locked packages: with uv (seconds), or with pip (minutes) where uv cannot be had. Both check every hash.
say "installing the locked packages (a first time downloads about 200 MB)"
if "$python" -m pip install --quiet --require-hashes --only-binary :all: -r "$installer" &&
    .venv/bin/uv pip sync --python "$python" --require-hashes "$lock" "$installer"; then
    .venv/bin/uv pip install --python "$python" --quiet --no-deps --no-build-isolation -e .
else
    say "uv is not available or failed: installing with pip instead, which takes a few minutes"
    "$python" -m pip install --require-hashes -r "$lock"
    "$python" -m pip install --quiet --no-deps --no-build-isolation -e .
fi

# 4. Complete.
stamp >"$ready.tmp"
mv -f "$ready.tmp" "$ready"
say "done: .venv is ready"
