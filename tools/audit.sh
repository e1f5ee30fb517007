#!/bin/bash
# Looks the locked dependencies up in the public databases of known vulnerabilities (pip-audit).
# Use: audit.sh FOLDER_OF_PYTHON. It needs a network; where there is none it says so, and ends with 3.
set -euo pipefail
"$1/python" -m pip install --quiet --disable-pip-version-check pip-audit
code=0
said=$("$1/python" -m pip_audit --strict --requirement requirements.lock \
    --requirement requirements-extras.lock --no-deps --disable-pip --progress-spinner off 2>&1) ||
    code=$?
echo "$said"
if ((code)) && ! grep -qE 'Found [0-9]+ known vulnerabilit' <<< "$said"; then
    echo "NOT AUDITED: the database of vulnerabilities could not be asked (no network, or no access to it)" >&2
    exit 3
fi
exit "$code"
