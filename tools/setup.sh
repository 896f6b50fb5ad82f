#!/usr/bin/env bash
# The environment that demo, tests and checks run in: system packages, a virtual environment, the package in it.
#
#   tools/setup.sh VENV PYTHON          set up VENV with the interpreter PYTHON, or repair it
#   tools/setup.sh --check VENV [ASKED] succeed at once if VENV was set up for this checkout (and by PYTHON=ASKED)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

EXTRAS=dev,perception,notebook,optuna,cluster,dataframe,recording
# A shared library that the wheels expect from the system, and Debian's package of it. pydrake and lcm link to GLib;
# everything else comes with the wheels or with any Debian.
LIBRARIES=(libglib-2.0.so.0:libglib2.0-0)

say() { printf 'setup: %s\n' "$*" >&2; }
fail() { say "$@"; exit 1; }

stamp_text() { printf 'checkout %s\npython %s\n' "$PWD" "$1"; }

if [ "${1:-}" = --check ]; then
    stamp=$2/.vtbdrake-installed
    [ -x "$2/bin/python" ] && [ -f "$stamp" ] || exit 1
    asked=${3:-$(sed -n 's/^python //p' "$stamp")}
    [ "$(cat "$stamp")" = "$(stamp_text "$asked")" ]
    exit
fi

[ $# -eq 2 ] || fail "usage: tools/setup.sh VENV PYTHON"
venv=$1 python=$2
stamp=$venv/.vtbdrake-installed
unfinished=$venv/.vtbdrake-unfinished

# Debian packages: as root they are installed, otherwise the user is told the command.
need_packages() {
    local command="apt-get install --yes --no-install-recommends $*"
    if ! command -v apt-get >/dev/null; then
        fail "missing on this system: the equivalent of Debian's $*; install it and run make again"
    fi
    if [ "$(id -u)" -ne 0 ]; then
        say "missing system packages: $*. Install them and run make again:"
        say "    sudo apt-get update && sudo $command"
        exit 1
    fi
    say "installing system packages: $*"
    export DEBIAN_FRONTEND=noninteractive
    apt-get update -qq
    $command -qq >/dev/null
}

command -v "$python" >/dev/null || {
    [ "$python" = python3 ] || fail "no interpreter '$python': set PYTHON to a Python of version 3.11 or newer"
    need_packages python3 python3-venv
}
"$python" -c '' || fail "'$python' does not run: set PYTHON to a Python of version 3.11 or newer"
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    fail "'$python' is Python $version, vtbdrake needs 3.11 or newer: set PYTHON, for example PYTHON=python3.11"

has_venv() { "$python" -c 'import ensurepip, venv' 2>/dev/null; }
has_library() { "$python" -c 'import ctypes, sys; ctypes.CDLL(sys.argv[1])' "$1" 2>/dev/null; }
missing() {
    has_venv || echo "python$version-venv"
    local entry
    for entry in "${LIBRARIES[@]}"; do
        has_library "${entry%%:*}" || echo "${entry##*:}"
    done
}
packages=$(missing)
if [ -n "$packages" ]; then
    # Debian's package of the module cannot help an interpreter that is not Debian's.
    if ! has_venv && [ "$("$python" -c 'import sys; print(sys.base_prefix)')" != /usr ]; then
        fail "'$python' lacks the modules venv and ensurepip: set PYTHON to one that has them"
    fi
    # shellcheck disable=SC2086
    need_packages $packages
    packages=$(missing)
    [ -z "$packages" ] || fail "still missing after the installation: "$packages
fi

# Only an environment that this script made may be replaced: one that was left unfinished or is of another Python.
if [ -e "$venv" ] && [ -n "$(ls -A "$venv")" ]; then
    if [ -e "$unfinished" ]; then
        say "$venv was left unfinished, starting again"
        rm -rf "$venv"
    elif [ ! -f "$stamp" ]; then
        fail "'$venv' exists and was not made by this script: choose another folder with VENV, or remove it"
    elif [ "$("$venv/bin/python" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)" != "$version" ]; then
        say "$venv is not of Python $version, starting again"
        rm -rf "$venv"
    fi
fi

# The newest tested set that this Python is not too old for.
constraints=
for file in $(printf '%s\n' constraints/py*.txt | sort -V); do
    minor=${file#constraints/py3}
    [ "${minor%.txt}" -gt "${version#3.}" ] || constraints=$file
done

mkdir -p "$venv"
touch "$unfinished"
rm -f "$stamp"
say "installing into $venv for Python $version with $constraints (a minute or two the first time)"
[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
pip() { "$venv/bin/python" -m pip --quiet --disable-pip-version-check "$@"; }
# The build tool comes first and in its tested version, so that the build needs no environment of its own.
pip install --constraint "$constraints" hatchling
pip install --constraint "$constraints" --no-build-isolation --editable ".[$EXTRAS]"
"$venv/bin/python" -c 'import pydrake.common, vtbdrake' || fail "the installed packages do not import"
rm "$unfinished"
stamp_text "$python" >"$stamp"
