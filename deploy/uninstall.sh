#!/bin/bash
# Removes the service and the program. Configuration, drop-ins and maps stay unless --purge is given.
set -euo pipefail

usage="usage: deploy/uninstall.sh [--prefix DIR] [--destdir DIR] [--no-systemctl] [--purge]"
prefix=/opt/prism-edge destdir='' systemctl=yes purge=no
while (($#)); do
    case $1 in
        --prefix) prefix=${2:?--prefix needs a folder}; shift ;;
        --destdir) destdir=${2:?--destdir needs a folder} systemctl=no; shift ;;
        --no-systemctl) systemctl=no ;;
        --purge) purge=yes ;;
        -h | --help) echo "$usage"; exit 0 ;;
        *) echo "$usage" >&2; exit 2 ;;
    esac
    shift
done
if [[ ! $prefix =~ ^(/[A-Za-z0-9._-]+)+$ ]]; then
    echo "uninstall.sh: error: --prefix must be an absolute path of letters, digits, . _ and -" >&2
    exit 2
fi
if [[ $EUID -ne 0 && -z $destdir ]]; then
    echo "uninstall.sh: error: run it as root, or with --destdir" >&2
    exit 1
fi

if [[ $systemctl == yes ]]; then
    mapfile -t units < <(systemctl list-units --all --plain --no-legend 'prism-edge.service' 'prism-edge@*.service' |
        awk '{print $1}')
    for unit in "${units[@]}"; do systemctl disable --now "$unit" 2> /dev/null || true; done
fi
rm -f "$destdir/etc/systemd/system/prism-edge.service" "$destdir/etc/systemd/system/prism-edge@.service"
rm -f "$destdir/etc/udev/rules.d/60-prism-edge-oak.rules" "$destdir/usr/local/bin/prism-edge"
rm -f "$destdir/etc/prism-edge/config.yaml.example"
# Only what an installation made: a prefix may be a folder that others use.
rm -rf "$destdir$prefix/releases" "$destdir$prefix/current" "$destdir$prefix/.lock"
rmdir "$destdir$prefix" 2> /dev/null || true
# Camera files and networks are the operator's, and stay.
rmdir "$destdir/srv/prism-edge/models" "$destdir/srv/prism-edge" 2> /dev/null || true
if [[ $purge == yes ]]; then
    rm -rf "$destdir/etc/prism-edge" "$destdir"/var/{lib,cache}/{,private/}prism-edge{,-*}
    # Of `systemctl edit`: they would take effect again at the next installation.
    rm -rf "$destdir"/etc/systemd/system/prism-edge{,@*}.service.d
fi
[[ $systemctl == no ]] || systemctl daemon-reload
echo "removed$([[ $purge == yes ]] || echo '; configuration and maps are kept (--purge removes them)')"
