#!/usr/bin/env bash
# What a release consists of, in dist/: the source distribution, and a wheel for the Python of an environment, built from it.
# The wheel is then installed into an empty environment, with the tested versions of what it depends on, and does there what
# a new user does first.
#
#   tools/dist.sh VENV
#
# There is a wheel for each Python: with the limited API (abi3) calls of the compiled modules take 1.2 to 1.4 times as long,
# and three of them use parts of Python that it does not have.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=$PWD/$1/bin/python
tag=$("$python" -c 'import sys; print("%d%d" % sys.version_info[:2])')
root=$PWD

say() { printf 'dist: %s\n' "$*" >&2; }

constraints=constraints/py$tag.txt
[ -f "$constraints" ] || { say "there is no $constraints: a release is for the Pythons that are tested"; exit 1; }

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
say "building"
# Nothing that this checkout has compiled is taken into account: the wheel is built from the source distribution.
"$python" -m build --no-isolation --outdir "$work" >"$work/log" 2>&1 || { cat "$work/log"; exit 1; }
mkdir -p dist
cp "$work"/*.tar.gz dist/
rm -f dist/*-cp"$tag"-*.whl
# The tag of the oldest Linux that has all that the wheel needs, instead of one that no registry takes.
PATH=${python%/*}:$PATH "$python" -m auditwheel repair --wheel-dir dist "$work"/*.whl >"$work/log" 2>&1 || { cat "$work/log"; exit 1; }
wheel=$(echo "$root"/dist/*-cp"$tag"-*.whl)

say "installing ${wheel##*/} into an empty environment"
"$python" -m venv "$work/venv"
"$work/venv/bin/python" -m pip --quiet --disable-pip-version-check install --constraint "$constraints" "$wheel"
say "running the programs of README.md and docs/start.md, and a new project"
for page in README docs/start; do
    awk '/^```/ { inside = /python$/; next } inside' "$page.md" >"$work/${page##*/}.py"
done
cd "$work"
MPLBACKEND=agg venv/bin/python -I README.py
MPLBACKEND=agg venv/bin/python -I start.py
[ -s payload.png ] && [ -s first.png ]
venv/bin/vtbdrake new trial >/dev/null
cd "$root"
ls -l dist
