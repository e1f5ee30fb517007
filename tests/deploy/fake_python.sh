#!/bin/bash
# A python for tests of the installer: `-I -m venv DIR` makes one that says what it is asked, and fails on demand.
set -eu
case "$*" in
    "-I -m venv "*)
        mkdir -p "$4/bin"
        case ${FAIL:-} in
            home/* | root/* | run/user/* | tmp/*) ln -s "/$FAIL" "$4/bin/python" ;; # need not be there
            *) cp "$0" "$4/bin/python" ;;
        esac
        ;;
    "-I -c "*) exec "$REAL_PYTHON" "$@" ;;
    "-I -m pip "*)
        [[ ${FAIL:-} != pip ]]
        # pip builds where the sources lie; what it was given is kept for the test to see.
        printf '%s\n' "$@" > "${0%/*}/asked"
        printf '#!%s\nimport prism_edge\n' "$0" > "${0%/*}/prism-edge"
        chmod +x "${0%/*}/prism-edge"
        sources=${!#}
        sources=${sources%[*}
        (cd "$sources" && find . -type f) > "${0%/*}/sources"
        mkdir -p "$sources/build/lib" "$sources/prism_edge.egg-info"
        touch "$sources/build/lib/built" "$sources/prism_edge.egg-info/PKG-INFO"
        ;;
    "-I -m prism_edge.cli config --check "*) [[ -e ${!#} && ${FAIL:-} != config ]] ;;
    "-I -m prism_edge.cli --version") [[ ${FAIL:-} != package ]] && echo "prism-edge 0" ;;
    "-m prism_edge.cli "*) ;; # a sound checkout in the present folder answers
    *) exit 64 ;;
esac
