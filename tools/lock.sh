#!/bin/bash
# Resolves pyproject.toml into exact versions, no registry host: requirements.lock, what make installs, and
# requirements-extras.lock, what cameras and metrics need besides. Use: lock.sh FOLDER_OF_PYTHON
set -euo pipefail
new=$(mktemp -d)
trap 'rm -rf "$new"' EXIT
resolve() {  # into a file of $new; then piptools' options
    local into=$new/$1
    shift
    "$python" -m piptools compile --quiet "$@" --strip-extras --allow-unsafe --no-annotate --no-header \
        --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --no-emit-options \
        --output-file "$into" pyproject.toml
    # The Python that resolves needs it, a newer one has it built in: the marker of those who ask for it is lost.
    sed -i -E 's/^backports-zstd==\S+$/& ; python_version < "3.14"/' "$into"
    # Releases of pip-tools differ in headings and order.
    sed -i -E '/^(#.*)?$/d' "$into"
    LC_ALL=C sort --output "$into" "$into"
    if grep -nE '://|^ *-' "$into"; then
        echo "error: the lines above name more than packages and versions" >&2
        exit 1
    fi
}
python=$1/python
resolve all --upgrade --extra dev
resolve extras --constraint "$new/all" --extra oak --extra streams --extra metrics
{
    echo "# Exact versions of everything installed by make, resolved from pyproject.toml by \`make lock\`."
    cat "$new/all"
} > requirements.lock
{
    echo "# Exact versions of what optional dependencies need besides requirements.lock, resolved by \`make lock\`."
    grep -vxFf "$new/all" "$new/extras" || true
} > requirements-extras.lock
