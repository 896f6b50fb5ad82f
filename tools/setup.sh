#!/usr/bin/env bash
# The environment that demo, tests and checks run in: system packages, a virtual environment, the package in it.
#
#   tools/setup.sh VENV PYTHON          set up VENV with the interpreter PYTHON, or repair it
#   tools/setup.sh VENV                 bring VENV up to date, with the interpreter that it was set up with
#   tools/setup.sh --check VENV [ASKED] succeed at once if VENV was set up for this checkout (and by PYTHON=ASKED)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

EXTRAS=all,dev,docs
# A shared library that the wheels expect from the system, and Debian's package of it. pydrake and lcm link to GLib;
# everything else comes with the wheels or with any Debian.
LIBRARIES=(libglib-2.0.so.0:libglib2.0-0)
# Cameras need EGL with Mesa's drivers; nothing else does.
RENDERING=(libegl1 libgl1-mesa-dri)
# The tests of pages look at them in a browser, and serve one with a certificate that openssl makes.
BROWSER=(chromium openssl)

say() { printf 'setup: %s\n' "$*" >&2; }
fail() { say "$@"; exit 1; }

stamp_text() { printf 'checkout %s\npython %s\n' "$PWD" "$1"; }

is_set_up() {
    local stamp=$1/.vtbdrake-installed
    [ -x "$1/bin/python" ] && [ -f "$stamp" ] || return 1
    local asked=${2:-$(sed -n 's/^python //p' "$stamp")}
    [ "$(cat "$stamp")" = "$(stamp_text "$asked")" ]
}

if [ "${1:-}" = --check ]; then
    is_set_up "$2" "${3:-}"
    exit
fi

[ $# -eq 1 ] || [ $# -eq 2 ] || fail "usage: tools/setup.sh VENV [PYTHON]"
venv=$1
stamp=$venv/.vtbdrake-installed
unfinished=$venv/.vtbdrake-unfinished
[ $# -eq 2 ] || [ -f "$stamp" ] || fail "'$venv' was not set up yet: name the interpreter to do so with"
python=${2:-$(sed -n 's/^python //p' "$stamp")}

# Where nothing but sources to compile has changed, compiling those is all there is to do.
# The installation below compiles from nothing: of another Cython, or other options, the ages of files say nothing.
if is_set_up "$venv" "$python" && [ -z "$(find pyproject.toml setup.py constraints tools/setup.sh -newer "$stamp")" ]; then
    say "compiling modules"
    "$venv/bin/python" setup.py --quiet build_ext --inplace || fail "vtbdrake does not compile, see above"
    touch "$stamp"
    exit
fi

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
    # One at a time: another environment may be set up in parallel.
    flock tools/setup.sh apt-get update -qq
    flock tools/setup.sh $command -qq >/dev/null
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
is_of_debian() { [ "$("$python" -c 'import sys; print(sys.base_prefix)')" = /usr ]; }
has_compiler() {
    local compiler=${CC:-$("$python" -c 'import sysconfig; print(sysconfig.get_config_var("CC"))')}
    # shellcheck disable=SC2086
    echo '#include <stdlib.h>' | $compiler -x c -fsyntax-only - 2>/dev/null
}
has_headers() { [ -f "$("$python" -c 'import sysconfig; print(sysconfig.get_path("include"))')/Python.h" ]; }
has_library() { "$python" -c 'import ctypes, sys; ctypes.CDLL(sys.argv[1])' "$1" 2>/dev/null; }
# Cameras are rendered by EGL without a display (Mesa's surfaceless platform); libEGL alone, without drivers, cannot.
can_render() {
    "$python" - 2>/dev/null <<'EOF'
from ctypes import CDLL, c_void_p
egl = CDLL("libEGL.so.1")
egl.eglGetPlatformDisplay.restype = c_void_p
display = egl.eglGetPlatformDisplay(0x31DD, c_void_p(), c_void_p())
raise SystemExit(not (display and egl.eglInitialize(c_void_p(display), None, None)))
EOF
}
missing() {
    has_venv || echo "python$version-venv"
    has_compiler || echo "gcc libc6-dev"
    has_headers || echo "python$version-dev"
    local entry
    for entry in "${LIBRARIES[@]}"; do
        has_library "${entry%%:*}" || echo "${entry##*:}"
    done
}
packages=$(missing)
if [ -n "$packages" ]; then
    # Debian's packages of Python's parts cannot help an interpreter that is not Debian's.
    if ! is_of_debian; then
        has_venv || fail "'$python' lacks the modules venv and ensurepip: set PYTHON to one that has them"
        has_headers || fail "'$python' lacks its headers (Python.h), to compile modules: set PYTHON to one that has them"
    fi
    # shellcheck disable=SC2086
    need_packages $packages
    packages=$(missing)
    [ -z "$packages" ] || fail "still missing after the installation: "$packages
fi
if ! can_render; then
    if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
        need_packages "${RENDERING[@]}"
        can_render || say "images cannot be rendered, although ${RENDERING[*]} are installed"
    else
        say "images cannot be rendered here, all else works. For cameras, install Debian's packages or their equivalent:"
        say "    sudo apt-get update && sudo apt-get install --yes --no-install-recommends ${RENDERING[*]}"
    fi
fi
has_browser() { command -v chromium >/dev/null || command -v google-chrome >/dev/null; }
if ! has_browser || ! command -v openssl >/dev/null; then
    if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
        need_packages "${BROWSER[@]}"
    else
        say "no browser or no openssl here, for tests of pages. For them, install Debian's packages or their equivalent:"
        say "    sudo apt-get update && sudo apt-get install --yes --no-install-recommends ${BROWSER[*]}"
    fi
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
# The build tools come first and in their tested versions, so that the build needs no environment of its own.
pip install --constraint "$constraints" setuptools Cython numpy lcm
rm -rf build/*"-$("$venv/bin/python" -c 'import sys; print(sys.implementation.cache_tag)')"
pip install --constraint "$constraints" --no-build-isolation --editable ".[$EXTRAS]" ||
    fail "vtbdrake does not compile, or what it depends on does not install, see above"
"$venv/bin/python" -c 'import pydrake.common, vtbdrake' || fail "the installed packages do not import"
rm "$unfinished"
stamp_text "$python" >"$stamp"
