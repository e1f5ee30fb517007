#!/bin/bash
# Installs prism_edge as a service, or upgrades it. Twice is the same as once; configuration and maps are kept;
# whatever fails, what ran before runs again. docs/DEPLOYMENT.md tells what goes where.
set -euo pipefail
umask 022  # the service's user must read what root writes here, however careful root is otherwise

usage() {
    cat <<'EOF'
usage: deploy/install.sh [options]
  --prefix DIR      where the program goes (default /opt/prism-edge)
  --destdir DIR     put DIR before every path, to build an image (implies --no-systemctl)
  --python PYTHON   interpreter, 3.11 or newer (default: the first that is found)
  --wheels DIR      install from the packages in DIR, without a network
  --extra NAME      optional dependencies of pyproject.toml, such as a camera's; may be repeated, and an upgrade
                    keeps those that there are
  --no-systemctl    write the files, but leave the running system alone
EOF
}

prefix=/opt/prism-edge destdir='' python='' wheels='' systemctl=yes extras=''
while (($#)); do
    case $1 in
        --prefix) prefix=${2:?--prefix needs a folder}; shift ;;
        --destdir) destdir=${2:?--destdir needs a folder} systemctl=no; shift ;;
        --python) python=${2:?--python needs an interpreter}; shift ;;
        --wheels) wheels=${2:?--wheels needs a folder}; shift ;;
        --extra) extras+="${extras:+,}${2:?--extra needs a name}"; shift ;;
        --no-systemctl) systemctl=no ;;
        -h | --help) usage; exit 0 ;;
        *) usage >&2; exit 2 ;;
    esac
    shift
done
if [[ ! $prefix =~ ^(/[A-Za-z0-9._-]+)+$ ]]; then
    echo "install.sh: error: --prefix must be an absolute path of letters, digits, . _ and -" >&2
    exit 2
fi

hidden='/root /home /run/user /tmp /var/tmp'  # from the service, by ProtectHome= and PrivateTmp= in the units
is_hidden() {
    local folder
    for folder in $hidden; do
        [[ $1/ != "$folder"/* && $1/ != "$(readlink -m "$folder")"/* ]] || return 0
    done
    return 1
}

# In an image, links of this machine mean nothing.
if is_hidden "$(realpath -m ${destdir:+--no-symlinks} "$prefix")"; then
    echo "install.sh: error: the service could not see $prefix; take another --prefix" >&2
    exit 2
fi

destdir=${destdir:+$(realpath -m "$destdir")} destdir=${destdir%/}
checkout=$(CDPATH="" cd "$(dirname "$0")/.." && pwd)
root=$destdir$prefix
units=$destdir/etc/systemd/system
rules=$destdir/etc/udev/rules.d
settings=$destdir/etc/prism-edge
command=$destdir/usr/local/bin/prism-edge
python=${python:-$(AVOID=$hidden "$checkout/tools/find_python.sh")}

if [[ $EUID -ne 0 && -z $destdir ]]; then
    echo "install.sh: error: run it as root, or with --destdir" >&2
    exit 1
fi
if [[ -r $root/current/extras ]]; then
    extras=$(tr ',' '\n' <<< "$(< "$root/current/extras")${extras:+,$extras}" | sort -u | paste -sd ,)
    echo "with optional dependencies: $extras"
fi
# pip itself passes over a name that it does not know.
[[ -z $extras ]] || "$python" -I -c '
import sys, tomllib
known = sorted(tomllib.load(open(sys.argv[1], "rb"))["project"]["optional-dependencies"])
for name in sys.argv[2].split(","):
    if name not in known:
        sys.exit(f"install.sh: error: --extra {name!r} is none of {known}")
' "$checkout/pyproject.toml" "$extras" || exit 2
# Two at once would each take the other's half for its own.
install -d -m 755 "$root" "$root/releases"
exec 9> "$root/.lock"
flock --nonblock 9 || { echo "install.sh: error: another installation is under way" >&2; exit 1; }

old=$(readlink "$root/current" || true)
new=releases/$(date -u +%Y%m%dT%H%M%S)-$$
saved=$(mktemp -d)
sources=$(mktemp -d)
files=("$units/prism-edge.service" "$units/prism-edge@.service" "$rules/60-prism-edge-oak.rules" "$command"
    "$settings/config.yaml.example")
# One that is there is never touched, nor a link to one that is not mounted just now.
is_there() { [[ -e $1 || -L $1 ]]; }
is_there "$settings/config.yaml" || files+=("$settings/config.yaml")

service() { [[ $systemctl == no ]] || systemctl "$@"; }

units_that_are() {
    [[ $systemctl == no ]] || systemctl list-units --plain --no-legend "--state=$1" \
        'prism-edge.service' 'prism-edge@*.service' | awk '{print $1}'
}

written='' restarted=()  # what there is to put back
mapfile -t running < <(units_that_are active,reloading)
mapfile -t starting < <(units_that_are activating)  # mostly one whose camera is away

undo() {
    local code=$?
    trap - EXIT
    # Who started it may be gone, with the terminal (ssh): all that follows is done, whoever hears of it.
    trap '' INT TERM HUP PIPE
    set +e
    rm -rf "$root/.current.new"
    if ((code)); then
        echo "install.sh: error: it failed; putting back what was there" >&2
        [[ -z $written ]] || put_back
        rm -rf "${root:?}/$new"
        # None that still runs as it did: a robot would lose its map.
        for unit in "${restarted[@]}"; do service restart "$unit" || true; done
    fi
    rm -rf "$saved" "$sources"
    exit "$code"
}

put_back() {
    for file in "${files[@]}"; do
        rm -f "$file"
        if [[ -e $saved/${file##*/} || -L $saved/${file##*/} ]]; then
            cp -a "$saved/${file##*/}" "$file"
        fi
    done
    if [[ -n $old ]]; then point_at "$old"; else rm -f "$root/current"; fi
    service daemon-reload || true
}

# A link that is renamed over the old one: there is no moment without a program.
point_at() {
    ln -sfn "$1" "$root/.current.new"
    mv -T "$root/.current.new" "$root/current"
}

# pip builds where the sources lie: a copy of them leaves nothing of root's in the checkout, and takes nothing
# along that an earlier build has left there.
copy_sources() {
    tar c -C "$checkout" --exclude=__pycache__ pyproject.toml setup.py README.md LICENSE prism_edge models |
        tar x -C "$sources" --no-same-owner
}

# pip writes into commands where they were built; where they will run, there is no such place.
name_final_paths() {
    local file content
    while IFS= read -r -d '' file; do
        content=$(< "$file")
        printf '%s\n' "${content//"$root/$new"/$prefix/$new}" > "$file"
    done < <(grep --recursive --files-with-matches --null -I --fixed-strings -e "$root/$new" "$root/$new/bin")
}

for file in "${files[@]}"; do
    if is_there "$file"; then cp -a "$file" "$saved/"; fi
done
trap undo EXIT
trap 'exit 130' INT TERM HUP PIPE

# -I: what is asked is the release, not what lies in the folder we are in or what PYTHONPATH names.
echo "installing into $root/$new"
"$python" -I -m venv "$root/$new"
interpreter=$(readlink -m "$root/$new/bin/python")
if [[ -z $destdir || $interpreter != "$destdir"/* ]] && is_hidden "$interpreter"; then
    echo "install.sh: error: the service, to which /root, /home and /tmp are closed, could not run $interpreter;" \
        "name another Python with --python" >&2
    exit 1
fi
pip=("$root/$new/bin/python" -I -m pip --quiet --disable-pip-version-check install)
copy_sources
[[ -z $wheels ]] || pip+=(--no-index --find-links "$wheels")
"${pip[@]}" --constraint "$checkout/requirements.lock" --constraint "$checkout/requirements-extras.lock" \
    "$sources${extras:+[$extras]}"
[[ -z $destdir ]] || name_final_paths
[[ -z $extras ]] || echo "$extras" > "$root/$new/extras"
"$root/$new/bin/python" -I -m prism_edge.cli --version
# Before any is stopped: one that refuses its own file would not come back with the release before it either.
for unit in "${running[@]}" "${starting[@]}"; do
    file=${unit#prism-edge@} file=$settings/${file%.service}.yaml
    [[ $unit != prism-edge@* || ! -e $file ]] ||
        "$root/$new/bin/python" -I -m prism_edge.cli config --check "$file"
done

written=yes
mkdir -p "$units" "$rules" "${command%/*}" "$destdir/srv/prism-edge/models"
install -d -m 755 "$settings"
install -m 644 "$checkout/deploy/60-prism-edge-oak.rules" "$rules/"
for unit in prism-edge.service prism-edge@.service; do
    sed "s#/opt/prism-edge/#$prefix/#g" "$checkout/systemd/$unit" > "$units/.$unit.new"
    chmod 644 "$units/.$unit.new"
    mv "$units/.$unit.new" "$units/$unit"
done
ln -sfn "$prefix/current/bin/prism-edge" "$command"
# An operator's file is never touched; what a release brings lies beside it.
install -m 644 "$checkout/deploy/config.yaml" "$settings/config.yaml.example"
is_there "$settings/config.yaml" || install -m 644 "$checkout/deploy/config.yaml" "$settings/config.yaml"
if [[ -e $settings/config.yaml ]]; then
    "$root/$new/bin/python" -I -m prism_edge.cli config --check "$settings/config.yaml"
else
    echo "install.sh: warning: $settings/config.yaml leads nowhere just now: not checked" >&2
fi

point_at "$new"
service daemon-reload
if [[ $systemctl == yes ]]; then  # a camera that is plugged in already keeps its old rights without a word
    { udevadm control --reload && udevadm trigger --subsystem-match=usb --attr-match=idVendor=03e7; } \
        2> /dev/null || true
fi
for unit in "${running[@]}"; do
    echo "restarting $unit"
    restarted+=("$unit")
    service restart "$unit"  # returns once it is ready; where it never is, all is put back
done
for unit in "${starting[@]}"; do
    echo "restarting $unit, which was not ready: not waiting for it"
    service restart --no-block "$unit" || true  # no fault of the release, and no reason to stop the others
done

# The release before this one stays, for a way back by hand.
for release in "$root"/releases/*; do
    [[ ${release#"$root"/} == "$new" || ${release#"$root"/} == "$old" ]] || rm -rf "$release"
done
echo "installed; configuration: $settings/config.yaml"
[[ $systemctl == no || ${#running[@]} -gt 0 || ${#starting[@]} -gt 0 ]] || echo "start it with: systemctl enable --now prism-edge"
