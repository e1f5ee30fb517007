#!/bin/bash
# A python for tests of the installer: `-m venv DIR` makes one that says what it is asked, and fails on demand.
set -eu
case "$*" in
    "-m venv "*)
        mkdir -p "$3/bin"
        cp "$0" "$3/bin/python"
        touch "$3/bin/prism-edge"
        ;;
    "-m pip "*)
        [[ ${FAIL:-} != pip ]]
        # pip builds where the sources lie; what it was given is kept for the test to see.
        printf '%s\n' "$@" > "${0%/*}/asked"
        sources=${!#}
        sources=${sources%[*}
        (cd "$sources" && find . -type f) > "${0%/*}/sources"
        mkdir -p "$sources/build/lib" "$sources/prism_edge.egg-info"
        touch "$sources/build/lib/built" "$sources/prism_edge.egg-info/PKG-INFO"
        ;;
    "-m prism_edge.cli config --check "*) [[ ${FAIL:-} != config ]] ;;
    "-m prism_edge.cli --version") echo "prism-edge 0" ;;
    *) exit 64 ;;
esac
