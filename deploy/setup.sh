#!/bin/sh
# Makes the virtual environment with everything that running, testing and developing need, and installs MONA where
# that can be done without asking anybody. Safe to repeat.
#
# Usage: sh deploy/setup.sh [FOLDER]      (default .venv)
#   PYTHON=...         the interpreter to use (3.11 or newer); by default the first suitable python3 on the path
#   T4NMTD_NO_APT=1    install no system packages
set -eu

cd "$(dirname "$0")/.."
venv=${1:-.venv}
oldest=3.11
log=$(mktemp)
trap 'rm -f "$log"' EXIT

say() { printf 'set-up: %s\n' "$*" >&2; }
fail() { say "$*"; exit 1; }

# Runs apt-get as root or through a sudo that asks for no password; its output is only shown if it fails.
can_apt() {
  [ -z "${T4NMTD_NO_APT:-}" ] && command -v apt-get >/dev/null || return 1
  [ "$(id -u)" = 0 ] || { command -v sudo >/dev/null && sudo -n true 2>/dev/null; }
}

as_root() {
  if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi
}

apt_install() {
  can_apt || return 1
  install="env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends -o DPkg::Lock::Timeout=30"
  as_root timeout 300 $install "$@" >"$log" 2>&1 </dev/null && return
  as_root timeout 120 apt-get update -q >"$log" 2>&1 </dev/null || true
  as_root timeout 300 $install "$@" >"$log" 2>&1 </dev/null || { tail -n 3 "$log" >&2; return 1; }
}

recent_enough() {
  "$1" -c "import sys; sys.exit(sys.version_info < tuple(map(int, '$oldest'.split('.'))))" 2>/dev/null
}

find_python() {
  for candidate in ${PYTHON:-python3 python3.13 python3.12 python3.11}; do
    if recent_enough "$candidate"; then echo "$candidate"; return; fi
  done
  return 1
}

ensure_venv_module() {
  "$python" -c 'import ensurepip, venv' 2>/dev/null && return
  number=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
  if can_apt; then
    say "$python lacks the venv module, which Debian keeps in a package of its own; installing it"
    apt_install "python$number-venv" || apt_install python3-venv || true
  fi
  "$python" -c 'import ensurepip, venv' 2>/dev/null ||
    fail "Python's venv module is missing. On Debian and Ubuntu: sudo apt-get install python3-venv; then run make again."
}

make_venv() {
  if [ -x "$venv/bin/python" ] && recent_enough "$venv/bin/python" && "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
    return
  fi
  say "making $venv with $("$python" --version)"
  "$python" -m venv --clear "$venv" || fail "could not make $venv; see above"
}

install_packages() {
  say "installing Python packages (about 250 MB the first time, which takes some minutes)"
  "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --constraint constraints.txt \
    --editable '.[test,dev]' || fail "pip could not install the packages; see above"
}

offer_mona() {
  if command -v mona >/dev/null; then
    say "MONA found at $(command -v mona); formulas are translated by it"
  elif can_apt && say "installing MONA" && apt_install mona && command -v mona >/dev/null; then
    say "MONA installed; formulas are translated by it"
  else
    say "MONA is not here and could not be installed: falling back to the Python translator, which gives the same" \
      "automata. (With MONA, big formulas take less time: sudo apt-get install mona.)"
  fi
}

python=$(find_python) ||
  fail "expected Python $oldest or newer; ${PYTHON:-python3} is $("${PYTHON:-python3}" --version 2>/dev/null || echo not there)." \
    "Install a newer one, or name it: make setup PYTHON=/path/to/python3"
ensure_venv_module
make_venv
install_packages
offer_mona
say "done; $venv/bin/t4nmtd is ready"
