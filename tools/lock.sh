#!/bin/bash
# Resolves pyproject.toml into requirements.lock: exact versions, no registry host. Use: lock.sh FOLDER_OF_PYTHON
set -euo pipefail
new=$(mktemp)
trap 'rm -f "$new"' EXIT
"$1/python" -m piptools compile --quiet --upgrade --extra dev --strip-extras --allow-unsafe --no-annotate --no-header \
    --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --no-emit-options \
    --output-file "$new" pyproject.toml
if grep -nE '://|^ *-' "$new"; then
    echo "error: the lines above name more than packages and versions" >&2
    exit 1
fi
{
    echo "# Exact versions of everything installed by make, resolved from pyproject.toml by \`make lock\`."
    cat "$new"
} > requirements.lock
