#!/usr/bin/env bash
# Fetches the tools for the scripts of the pages by npm, beside this file, once for each version of package.json. It
# fails, with the reason, where there is no node, or nothing to fetch them from.
set -eu
cd "$(dirname "$0")"
if ! command -v npm >/dev/null; then
    echo "there is no node (npm)"
    exit 1
fi
if command -v flock >/dev/null; then
    exec 9>.lock # Two test runs may begin at once.
    flock 9
fi
stamp=node_modules/.versions
if ! cmp --quiet package.json "$stamp"; then
    if ! npm install --silent --fetch-retries 0; then
        echo "npm cannot fetch the tools"
        exit 1
    fi
    cp package.json "$stamp"
fi
