#!/usr/bin/env bash
# Checks the scripts of the pages: their types by tsc, eslint, and prettier. `check.sh --write` lays them out.
# Where there is no node, or nothing to fetch the tools from, this is said, and left out.
set -eu
cd "$(dirname "$0")"
if ! reason=$(./install.sh); then
    echo "The scripts of the pages are not checked: $reason."
    exit 0
fi
# Configurations are found beside the tools, not beside the scripts.
pages=$(cd ../.. && find vtbdrake -path '*/page/*' \( -name '*.js' -o -name '*.css' -o -name '*.html' \) \
    -not -path '*/vendor/*' | sort)
tools=$PWD
cd ../..
"$tools/node_modules/.bin/prettier" --config "$tools/.prettierrc.json" "${1:---check}" --log-level warn $pages
"$tools/node_modules/.bin/eslint" --config "$tools/eslint.config.js" $(printf '%s\n' $pages | grep '\.js$')
"$tools/node_modules/.bin/tsc" -p "$tools/tsconfig.json"
