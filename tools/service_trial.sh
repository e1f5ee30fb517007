#!/bin/bash
# Tries the service under a real systemd: boots a container whose root is this machine's own, with changes kept
# in memory, installs prism_edge there, and looks at what an operator would see. Needs root and systemd-nspawn
# (Debian: systemd-container). Some minutes; prints a line for each thing tried, and ends with 1 if any is not so.
#   tools/service_trial.sh MODEL.onnx [PYTHON]
# shellcheck disable=SC2317  # functions that only a trap or another function calls
set -euo pipefail
model=$(readlink -f "${1:?usage: tools/service_trial.sh MODEL.onnx [PYTHON]}")
python=${2:-/usr/bin/python3}
checkout=$(cd "$(dirname "$0")/.." && pwd)
((EUID == 0)) || { echo "service_trial.sh: needs root" >&2; exit 2; }
command -v systemd-nspawn > /dev/null ||
    { echo "service_trial.sh: needs systemd-nspawn (Debian: apt install systemd-container)" >&2; exit 2; }
work=$(mktemp -d)
failed=0

end() {
    [[ -z ${guest:-} ]] || kill "$guest" 2> /dev/null || true
    [[ -z ${guest:-} ]] || wait "$guest" 2> /dev/null || true
    umount "$work/root" "$work/changes" 2> /dev/null || true
    rm -rf --one-file-system "$work"
}
trap end EXIT

mkdir "$work/changes" "$work/root"
mount -t tmpfs tmpfs "$work/changes"
mkdir "$work/changes/upper" "$work/changes/work"
mount -t overlay overlay "$work/root" \
    -o "lowerdir=/,upperdir=$work/changes/upper,workdir=$work/changes/work"
root=$work/root
# Only what a bare system starts, and a machine of its own.
rm -rf "$root/etc/systemd/system/"*.wants "$root/etc/prism-edge" "$root/opt/prism-edge" "$root/etc/machine-id"
echo uninitialized > "$root/etc/machine-id"
mkdir -p "$root/opt/src" "$root/srv/models"
(cd "$checkout" && git ls-files -co --exclude-standard | tar c --ignore-failed-read -T -) | tar x -C "$root/opt/src"
cp "$model" "$root/srv/models/net.onnx"
cp "$model.yaml" "$root/srv/models/net.onnx.yaml" 2> /dev/null || true  # not every network needs a card

systemd-nspawn --quiet --boot --directory "$root" --register=no --keep-unit --console=pipe \
    --machine=prism-trial < /dev/null > "$work/console" 2>&1 &
guest=$!
inside() { nsenter --target "$leader" --all -- "$@"; }
await() {  # seconds, then a command that must come true
    local end=$((SECONDS + $1))
    shift
    until "$@" > /dev/null 2>&1; do
        ((SECONDS < end)) || return 1
        sleep 0.3
    done
}
is() {  # what, then a command that must be true
    local what=$1
    shift
    if "$@" > /dev/null 2>&1; then echo "ok    $what"; else echo "FAIL  $what"; failed=1; fi
}
has_started_again() { (($(inside systemctl show --property NRestarts --value "$1") > 0)); }
property() { inside systemctl show --property "$1" --value prism-edge; }
status_has() { [[ $(property StatusText) == *"$1"* ]]; }
status_begins() { [[ $(property StatusText) == "$1"* ]]; }
restarts_are() { [[ $(property NRestarts) == "$1" && $(property ActiveState) == active ]]; }
state_is() { [[ $(property ActiveState) == "$1" ]]; }
said() { grep -qF "$1" <(inside journalctl --unit prism-edge --no-pager --output cat); }
of_main() { grep -qE "$1" <(inside cat "/proc/$(property MainPID)/status"); }
no_worker() { ! inside pgrep -f '^prism-edge (source|tracker|depth|scale|backend)'; }
current() { inside readlink /opt/prism-edge/current; }

leader_is_up() {  # `degraded` is this machine's own affair
    leader=$(pgrep --parent "$guest" systemd) && 
        [[ $(inside systemctl is-system-running) =~ ^(running|degraded)$ ]]
}
await 60 leader_is_up || { cat "$work/console"; echo "FAIL  systemd does not boot"; exit 1; }
echo "ok    systemd $(inside systemctl --version | awk 'NR==1{print $2}') has booted"

install_it() { inside /opt/src/deploy/install.sh --python "$python"; }
printf '#!/bin/sh\necho "$*" >> /run/udev-calls\n' | inside tee /usr/local/bin/udevadm > /dev/null  # none runs there
inside chmod +x /usr/local/bin/udevadm
is "install" install_it
is "... applies the rule to OAK cameras that are plugged in" inside grep -q 'trigger.*03e7' /run/udev-calls
printf 'source: {uri: "sim:room", loop: true}\ndepth: {model: /srv/models/net.onnx}\n' > "$work/config"
inside tee /etc/prism-edge/config.yaml < "$work/config" > /dev/null
mkdir -p "$root/etc/systemd/system/prism-edge.service.d"
printf '[Service]\nWatchdogSec=8\nRestartSec=1\n' | inside tee /etc/systemd/system/prism-edge.service.d/trial.conf > /dev/null
inside systemctl daemon-reload
is "start returns once poses can flow" inside systemctl start prism-edge
is "poses flow, and the status line says so" await 30 status_has "ok building"
is "a user of its own" of_main '^Uid:\s+[1-9]'
is "the release that it was started from, not the link to it" \
    inside grep --quiet --text /opt/prism-edge/releases/ "/proc/$(property MainPID)/cmdline"
is "no capabilities" of_main '^CapBnd:\s+0+$'
is "system calls are filtered" of_main '^Seccomp:\s+2$'
is "no new privileges" of_main '^NoNewPrivs:\s+1$'

logged() { [[ -n $(inside journalctl --unit prism-edge --output cat PRISM_PROCESS="$1") ]]; }
is "log lines have their fields in the journal" logged depth
is "a command is answered" inside prism-edge ctl info
is "a map is saved, once it has two keyframes" await 30 inside prism-edge ctl save_map trial
is "... in the state directory" inside test -s /var/lib/prism-edge/maps/trial.prismmap

printf 'source: {uri: "sim:room", loop: true}\ndepth: {model: /srv/models/net.onnx, threads: 2}\nrobot: other\n' |
    inside tee /etc/prism-edge/config.yaml > /dev/null
is "reload" inside systemctl reload prism-edge
is "what can change is taken up" await 10 said "reloaded: depth.threads"
is "what can't is refused" said "only a restart changes it: robot"
inside tee /etc/prism-edge/config.yaml < "$work/config" > /dev/null

tracker=$(inside pgrep -f '^prism-edge tracker')
inside kill -KILL "$tracker"
is_another() { local now; now=$(inside pgrep -f '^prism-edge tracker') && [[ $now != "$tracker" ]]; }
is "a killed tracker is started again" await 20 is_another
is "... and mended" await 20 status_begins "ready, ok building"
is "... without a restart of the service" restarts_are 0
inside kill -KILL "$(property MainPID)"
is "a killed supervisor leaves no worker" await 3 no_worker
is "... and the service is started again" await 40 restarts_are 1
inside kill -STOP "$(property MainPID)"
is "a supervisor that stands still is found by the watchdog" await 40 restarts_are 2
is "... and said to be" said "Watchdog timeout"

echo '{width: 640, height: 480, fx: 500, fy: 500, cx: 320, cy: 240}' | inside tee /srv/models/rear.yaml > /dev/null
printf 'robot: rear\nsource: {uri: "v4l2:/dev/video9", camera: /srv/models/rear.yaml, absent_s: 1}\n%s\n' \
    'bus: {endpoint: "tcp/127.0.0.1:7450"}' | inside tee /etc/prism-edge/rear.yaml > /dev/null
inside systemctl start --no-block prism-edge@rear
is "one without its camera keeps trying" await 20 has_started_again prism-edge@rear
{ cat "$work/config"; printf 'robot: front\nbus: {endpoint: "tcp/127.0.0.1:7460"}\n'; } |
    inside tee /etc/prism-edge/front.yaml > /dev/null
is "another camera's service starts beside it" inside systemctl start prism-edge@front
echo 'robot: [' | inside tee /etc/prism-edge/front.yaml > /dev/null
broken() { ! install_it; }
supervisor=$(property MainPID)
is "an upgrade that would find its file wrong fails" broken
is "... before any service is stopped" test "$supervisor" = "$(property MainPID)"
is "... this one, too" inside systemctl is-active prism-edge@front
inside systemctl stop prism-edge@front
inside rm /etc/prism-edge/front.yaml
before=$(current)
is "upgrade of the running service, beside it" install_it
inside systemctl stop prism-edge@rear
is "... to another release" test "$before" != "$(current)"
is "... with the configuration kept" inside grep -q sim:room /etc/prism-edge/config.yaml
is "... and poses again" await 30 status_has "ok building"
times_found() { inside journalctl --unit prism-edge --no-pager --output cat | grep -c "found again at frame"; }
found=$(times_found) || true
is_found_once_more() { (($(times_found) > found)); }
is "... and the map from before, which is loaded" inside prism-edge ctl load_map trial
is "... and the camera found in it" await 30 is_found_once_more
is "... and poses in it" await 10 status_begins "ready, ok building"
before=$(current)
inside sed -i 's/^TimeoutStartSec=.*/TimeoutStartSec=1ms/' /opt/src/systemd/prism-edge.service
is "an upgrade whose service does not start fails" broken
is "... and puts the release before it back" test "$before" = "$(current)"
is "... which runs" await 40 state_is active

inside sh -c 'echo "robot: [" > /etc/prism-edge/config.yaml'
inside systemctl restart prism-edge 2> /dev/null || true
is "a wrong configuration ends the service" await 20 state_is failed
is "... with its own code, and no attempt more" test "$(property ExecMainStatus)" = 3
is "... and a line that says what is wrong" said "config.yaml:"

is "removal" inside /opt/src/deploy/uninstall.sh
is "... keeps the configuration" inside test -e /etc/prism-edge/config.yaml
is "... and the maps" inside test -s /var/lib/private/prism-edge/maps/trial.prismmap
is "... and nothing else" inside sh -c '! test -e /opt/prism-edge -o -e /etc/systemd/system/prism-edge.service'
exit "$failed"
