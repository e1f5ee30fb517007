#!/bin/bash
# Prints a Python >= 3.11 that can make virtual environments; says what is missing where there is none.
# One that really lies below a folder of $AVOID (separated by spaces) is the last choice. Where $PYTHON names
# one, it is that or none.
set -u
check='import sys; sys.exit(0 if sys.version_info >= (3, 11) else 1)'
place='import os, sys; print(os.path.realpath(getattr(sys, "_base_executable", sys.executable)))'
seen='' last_choice=''
names=(python3.13 python3.12 python3.11 python3.14 python3 python)
[ -z "${PYTHON:-}" ] || names=("$PYTHON")
for name in "${names[@]}"; do
    # Every one on the path: the first may be too old, or a shim with nothing behind it.
    while IFS= read -r python; do
        # -I: whatever lies in the folder that we are in.
        "$python" -I -c "$check" >/dev/null 2>&1 </dev/null || continue
        seen=$python
        "$python" -I -c 'import venv, ensurepip' >/dev/null 2>&1 </dev/null || continue
        real=$("$python" -I -c "$place" 2>/dev/null </dev/null)
        for folder in ${AVOID:-}; do
            if [[ $real == "$folder"/* ]]; then
                last_choice=${last_choice:-$python}
                continue 2
            fi
        done
        echo "$python"
        exit 0
    done < <(type -aP "$name" 2>/dev/null)
done
if [ -n "$last_choice" ]; then
    echo "$last_choice"
    exit 0
fi
if [ -n "$seen" ]; then
    echo "error: $seen can't make virtual environments; install its venv module (Debian: apt install python3-venv)" >&2
elif [ -n "${PYTHON:-}" ]; then
    echo "error: PYTHON=$PYTHON is no Python >= 3.11" >&2
else
    echo "error: no Python >= 3.11 found; install one, or name it: make PYTHON=/path/to/python3 ..." >&2
fi
exit 1
