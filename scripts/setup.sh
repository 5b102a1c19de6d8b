#!/usr/bin/env bash
# Makes the environment. Called by the Makefile with PYTHON and VENV.
set -euo pipefail

fail() { printf 'setup: %s\n' "$*" >&2; exit 2; }

command -v "$PYTHON" >/dev/null || fail "no $PYTHON found; install Python 3.11 or newer, or say make PYTHON=/path/to/python"
"$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
  fail "$("$PYTHON" --version) is too old; Python 3.11 or newer is needed: make PYTHON=/path/to/python"

# Debian splits venv from Python: install it where we may, and say what is missing where not.
if ! "$PYTHON" -c 'import ensurepip' 2>/dev/null; then
  package="$("$PYTHON" -c 'import sys; print(f"python3.{sys.version_info.minor}-venv")')"
  as_root=""
  [ "$(id -u)" = 0 ] || as_root="sudo -n"
  if command -v apt-get >/dev/null && { [ -z "$as_root" ] || sudo -n true 2>/dev/null; }; then
    echo "setup: installing $package"
    $as_root apt-get update -qq && $as_root apt-get install -y -qq "$package" >/dev/null ||
      fail "could not install $package; install it by hand and try again"
  else
    fail "Python lacks its venv module; install the package $package (as root: apt-get install $package) and try again"
  fi
fi

[ -x "$VENV/bin/python" ] || "$PYTHON" -m venv "$VENV"
echo "setup: installing into $VENV"
quiet() { "$VENV/bin/python" -m pip install --quiet --disable-pip-version-check --no-input "$@"; }
# Every file is compared with requirements.lock. Where a mirror builds its own files, say HASHES=no.
case "${HASHES:-yes}" in
  yes) pinned=(--require-hashes --no-deps --requirement requirements.lock) ;;
  no) pinned=(--no-deps --requirement constraints.txt) ;;
  *) fail "HASHES=$HASHES; say yes or no" ;;
esac
# uv does in seconds what takes pip minutes; where its index is not to be had, pip does it.
# Modules are compiled here once: where Python may not write beside them, as under the units of
# docs/how-to/deploy.md, each start would compile them all again.
uv=("$VENV/bin/uv" pip install --quiet --compile-bytecode --python "$VENV/bin/python")
{ echo "# uv alone"; awk '/^[^ #]/ { on = /^uv==/ } on' "${pinned[-1]}"; } >"$VENV/uv.lock"
quiet "${pinned[@]:0:${#pinned[@]}-1}" "$VENV/uv.lock" || echo "setup: no uv; pip takes some minutes"
"${uv[@]}" "${pinned[@]}" ||
  quiet "${pinned[@]}" ||
  fail "packages could not be installed; where a file differs from requirements.lock, do not use it"
"${uv[@]}" --constraint constraints.txt --editable ".[dev]" ||
  quiet --constraint constraints.txt --editable ".[dev]"
"$VENV/bin/python" -m compileall -q src || true
