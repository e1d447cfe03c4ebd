#!/bin/bash
# first_hour.sh FOLDER [SUITE]: the first hour of a newcomer on a bare Debian (bookworm), from `apt install` to a calibration
# of the emulated rig, with times. The transcript goes to stdout as Markdown; docs/tutorial/first_hour.md is one of them.
# Run as root in a checkout, whose committed state is used; needs debootstrap. FOLDER takes the Debian (1 GB), which is made
# anew by each run from SUITE.tar there.
# MIRROR=URL: where Debian comes from, if not from debootstrap's default. CERTIFICATES=FILE: for pip behind a proxy.
set -euo pipefail
folder=${1:?a folder for the bare Debian} suite=${2:-bookworm}
root=$folder/$suite here=$(git -C "$(dirname "$0")" rev-parse --show-toplevel)
[ "$(id -u)" = 0 ] || { echo "run it as root: it makes a chroot" >&2; exit 2; }
command -v debootstrap >/dev/null || { echo "debootstrap is missing: apt install debootstrap" >&2; exit 2; }
for place in proc dev tmp; do
    ! mountpoint -q "$root/$place" || { echo "$root/$place is still mounted: umount -l it first" >&2; exit 1; }
done
rm -rf --one-file-system "$root" && mkdir -p "$root"
if [ -f "$root.tar" ]; then
    tar -C "$root" -xf "$root.tar"
else
    debootstrap --variant=minbase "$suite" "$root" ${MIRROR:+"$MIRROR"} >&2
    tar -C "$root" -cf "$root.tar" .
fi

mounted=()
clean_up() { for ((k = ${#mounted[@]} - 1; k >= 0; k--)); do umount -l "${mounted[k]}" || true; done; }
trap clean_up EXIT
hang() { mount "${@:2}" "$1" && mounted+=("$1"); }
hang "$root/proc" -t proc proc
hang "$root/dev" --rbind /dev
mount --make-rslave "$root/dev"
hang "$root/tmp" -t tmpfs -o mode=1777 tmpfs
cp /etc/resolv.conf /etc/hosts "$root/etc/"
git clone -q --bare "$here" "$root/vical.git"
chroot "$root" useradd --create-home --shell /bin/bash ann
chroot "$root" chown -R ann: /vical.git

cat >"$root/tmp/as_root" <<'STEPS'
say 'A bare Debian has neither Python nor git.'
run 'apt-get -qq update && apt-get -qq install -y --no-install-recommends python3-venv make git ca-certificates' 0
STEPS
cat >"$root/tmp/as_ann" <<'STEPS'
cd
say 'From here on as an ordinary user. All packages of Python go into `.venv` of the checkout.'
run "git clone -q $ORIGIN vical && cd vical && make install" 2
cd ~/vical && PATH=$PWD/.venv/bin:$PATH
run 'vical doctor' 20
mkdir rig && cd rig
say 'Nothing is plugged in here. `vical init` reports that and names the option for an emulated rig.'
run 'vical init' 6 1
run 'vical init --emulated' 12
say 'The script runs the service in the background. Use a terminal of its own; the page is at http://127.0.0.1:8080/.'
vical run -c vical.yaml --quiet 2>run.log &
service=$!
run 'vical watch -c vical.yaml --until-converged --timeout 300 >/dev/null && echo converged' 3
say 'The calibration is stored as soon as it is `converged`. This is what other software gets:'
run 'vical export store --format kalibr -o camchain.yaml && head -12 camchain.yaml' 16
kill -INT $service && wait $service || true
say 'The same offline: two demos of the same rig give one calibration.'
run 'for k in 1 2; do vical demo --seconds 15 --seed $k --out rec$k --quiet >/dev/null || true; done; ls rec1' 8
run 'vical calibrate rec1/*.mcap rec2/*.mcap --target rec1/target.yaml -o result.json --report report.html && ls -s report.html' 40
STEPS
cat >"$root/tmp/transcript" <<'RUNNER'
# transcript STEPS: runs the steps and prints them as Markdown, with the seconds each took.
export LANG=C.UTF-8 DEBIAN_FRONTEND=noninteractive PIP_DEFAULT_TIMEOUT=180
say() { printf '\n%s\n' "$1"; }
run() { # command, lines of its output that are shown, exit code that is expected (0)
    local begin=$EPOCHREALTIME code=0 output
    output=$(mktemp)
    printf '\n```console\n$ %s\n' "$1"
    eval "$1" >"$output" 2>&1 || code=$?
    head -n "$2" "$output"
    rm "$output"
    [ "$code" = 0 ] || printf '(exit code %s)\n' "$code"
    [ "$code" = "${3:-0}" ] || { echo "$1: exit code $code" >&2; exit 1; }
    printf '```\n\n*%s s*\n' "$(awk -v a="$begin" -v b="$EPOCHREALTIME" 'BEGIN { printf "%.1f", b - a }')"
}
. "$1"
RUNNER
environment=(env -i PATH=/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin ORIGIN=/vical.git)
if [ -n "${CERTIFICATES:-}" ]; then
    cp "$CERTIFICATES" "$root/tmp/certificates"
    environment+=(PIP_CERT=/tmp/certificates)
fi
begin=$SECONDS
"${environment[@]}" HOME=/root chroot "$root" bash /tmp/transcript /tmp/as_root
"${environment[@]}" HOME=/home/ann chroot --userspec=ann:ann "$root" bash /tmp/transcript /tmp/as_ann
printf '\nAll of it: %s s, on %s with %s cores, %s.\n' $((SECONDS - begin)) "$(uname -m)" "$(getconf _NPROCESSORS_ONLN)" \
    "$(. "$root/etc/os-release" && echo "$PRETTY_NAME")"
