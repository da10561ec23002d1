#!/usr/bin/env bash
# Build the container image without a container engine, start it as it is meant to run, use it, stop it.
#
#     sudo tools/container_check.sh [FOLDER]
#
# FOLDER (default: lensmodel-container in the temporary folder) keeps the base system and the built layers, so
# that a second run is quick. Needs root and Debian's packages buildah, debootstrap, util-linux and curl.
# Packages come from where this machine's apt and pip are configured to take them; the configuration is lent to
# the build and is no part of the image.
#
# Checked: it builds on a bare base; runs as a user without rights, with a read-only root and as process 1;
# becomes ready and healthy; takes a photo and calibrates from it; stops on SIGTERM with status 0; writes nothing
# outside /data; and keeps what it knew over a restart. Then, where Debian's postgresql and Python's moto[server]
# are there too (PYTHON names an interpreter that has it; default: that of `make install`), the API and the worker
# of compose.yaml run as two such containers on PostgreSQL and S3, and photos are decoded by a user of their own.
set -euo pipefail

here=$(cd "$(dirname "$0")/.." && pwd)
patience=300 # seconds that each wait may take; a busy machine needs most of them
folder=${1:-${TMPDIR:-/tmp}/lensmodel-container}
photo=$here/lensmodel/demo_data/city.jpg
packages=python3,python3-venv,ca-certificates
service=""
parts=()

say() { printf 'container-check: %s\n' "$*"; }
fail() {
  say "FAILED: $*" >&2
  for log in service api worker; do
    if [ -f "$folder/$log.log" ]; then tail -n 20 "$folder/$log.log" >&2; fi
  done
  exit 1
}

[ "$(id -u)" = 0 ] || fail "must run as root: it makes a base system and mounts it"
for program in buildah debootstrap unshare setpriv curl; do
  command -v "$program" >/dev/null || fail "$program is missing; apt-get install buildah debootstrap util-linux curl"
done
mkdir -p "$folder"
exec {lock}>"$folder/lock"
flock --nonblock "$lock" || fail "another check works in $folder"

engine() { buildah --root "$folder/storage" --runroot "$folder/run" "$@"; }

cleanup() {
  for started in $service ${parts[@]+"${parts[@]}"}; do kill -KILL "$started" 2>/dev/null || true; done
  if [ -n "${SERVERS_PID:-}" ]; then
    eval "exec ${SERVERS[1]}>&-" # they end themselves, and what they started
    wait "$SERVERS_PID" || true
  fi
  engine rm --all >/dev/null 2>&1 || true
}
trap cleanup EXIT

# --- the base: what a registry would give, made by hand ---------------------------------------------------------

make_base() {
  local suite mirror
  suite=$(. /etc/os-release && echo "${VERSION_CODENAME:-bookworm}")
  mirror=$(apt-get indextargets --format '$(CODENAME) $(REPO_URI)' 'Created-By: Packages' \
    | awk -v suite="$suite" '$1 == suite { print $2; exit }')
  say "making a base system ($suite) ..."
  debootstrap --variant=minbase --include="$packages" "$suite" "$folder/base.part" ${mirror:+"$mirror"} \
    >"$folder/debootstrap.log" 2>&1 || fail "debootstrap: see $folder/debootstrap.log"
  # A public base names no mirror of this machine.
  rm -rf "$folder"/base.part/var/cache/apt/archives/*.deb "$folder"/base.part/var/lib/apt/lists/*
  : >"$folder/base.part/etc/apt/sources.list"
  rm -f "$folder/base.part/etc/resolv.conf" "$folder/base.part/etc/hostname"
  mv "$folder/base.part" "$folder/base"
}

if ! engine inspect --type image lensmodel-base >/dev/null 2>&1; then
  rm -rf "$folder/base.part"
  [ -d "$folder/base" ] || make_base
  made=$(engine from scratch)
  engine add --quiet "$made" "$folder/base" / >/dev/null
  engine commit --quiet "$made" lensmodel-base >/dev/null
  engine rm "$made" >/dev/null
fi

# --- the build --------------------------------------------------------------------------------------------------

# pip's settings of this machine, from files and environment, as one file that is mounted and not copied.
python3 -m pip config list | python3 -c '
import ast, sys
found = {}
for line in sys.stdin:
    name, _, value = line.strip().partition("=")
    if name.startswith(("global.", ":env:.")) and name.rpartition(".")[2] != "cert":
        found[name.rpartition(".")[2]] = " ".join(str(ast.literal_eval(value)).split())
print("[global]", *(f"{name} = {value}" for name, value in found.items()), sep="\n")
' >"$folder/pip.conf"
lent=(--volume "$folder/pip.conf:/etc/pip.conf:ro")
if [ -d /etc/ssl/certs ]; then lent+=(--volume /etc/ssl/certs:/etc/ssl/certs:ro); fi
for path in $(grep -oE '(file://)?/[^ ]+' "$folder/pip.conf" | sed 's#^file://##' | sort -u); do
  path=${path%/simple}
  # folders of packages, and files such as one of constraints
  if [ -e "$path" ]; then lent+=(--volume "$path:$path:ro"); fi
done

say "building the image ..."
engine bud --format docker --isolation chroot --pull-never --layers --build-arg BASE=localhost/lensmodel-base \
  "${lent[@]}" --tag lensmodel --file "$here/Dockerfile" "$here" >"$folder/build.log" 2>&1 \
  || { tail -n 30 "$folder/build.log" >&2; fail "the image does not build"; }

config() { engine inspect --type image --format "{{$1}}" lensmodel; }

[ "$(config .OCIv1.Config.User)" = 10001:10001 ] || fail "the image's user is '$(config .OCIv1.Config.User)'"
container=$(engine from --pull-never lensmodel)
root=$(engine mount "$container")
for tool in pytest ruff hatchling gcc; do
  if chroot "$root" sh -c "command -v $tool || command -v /opt/lensmodel/bin/$tool" >/dev/null; then
    fail "$tool is in the image that runs; only the build may have it"
  fi
done
if grep -rqs 'index-url\|find-links' "$root/etc/pip.conf"; then fail "this machine's pip settings are in the image"; fi

# --- the run ----------------------------------------------------------------------------------------------------

mapfile -t environment < <(engine inspect --type image lensmodel \
  | python3 -c 'import json, sys; print(*json.load(sys.stdin)["OCIv1"]["config"]["Env"], sep="\n")')
mapfile -d '' -t command < <(engine inspect --type image lensmodel | python3 -c '
import json, sys
config = json.load(sys.stdin)["OCIv1"]["config"]
sys.stdout.write("".join(part + "\0" for part in [*config["Entrypoint"], *config["Cmd"]]))')
mapfile -d '' -t health < <(engine inspect --type image lensmodel | python3 -c '
import json, sys
found = json.load(sys.stdin)["Docker"]["config"].get("Healthcheck") or {}
sys.stdout.write("".join(part + "\0" for part in found.get("Test", [])[1:]))')
mapfile -d '' -t entry < <(engine inspect --type image lensmodel | python3 -c '
import json, sys
sys.stdout.write("".join(part + "\0" for part in json.load(sys.stdin)["OCIv1"]["config"]["Entrypoint"]))')
port=$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
# A cheap estimator and few patches: this is about the container.
environment+=("LENS_PORT=$port" LENS_SANDBOX=try LENS_PATCHES=4)
inside=(setpriv --reuid=10001 --regid=10001 --clear-groups --no-new-privs --bounding-set=-all --inh-caps=-all)
# As compose.yaml has its worker begin.
as_root=(setpriv --reuid=0 --regid=0 --clear-groups --no-new-privs --bounding-set=-all,+setuid,+setgid,+kill --inh-caps=-all)

rm -f "$folder"/{service,api,worker}.log

volume() {
  # An empty volume of its own for what runs next, and where its root appears.
  data=$folder/data$1 mount=$folder/mount$1
  rm -rf "$data" "$mount"
  mkdir "$mount"
  install -d -o 10001 -g 10001 -m 0750 "$data"
}

volume ""

isolated() {
  # Become a container, in a subshell: new mount and process namespaces, and what an engine adds to the image's
  # files: /proc, /dev, /dev/shm, the volume. Whoever kills the process that this becomes kills all inside.
  exec unshare --mount --propagation private --pid --fork --kill-child=KILL bash -euc '
    root=$1 mount=$2 data=$3; shift 3
    mount --bind "$root" "$mount"
    mount -o remount,bind,ro "$mount"
    mount -t proc proc "$mount/proc"
    mount -t tmpfs -o mode=755,nosuid tmpfs "$mount/dev"
    for node in null zero random urandom; do touch "$mount/dev/$node"; mount --bind "/dev/$node" "$mount/dev/$node"; done
    mkdir -m 1777 "$mount/dev/shm"
    mount --bind "$data" "$mount/data"
    cd /
    exec "$@"
  ' - "$root" "$mount" "$data" \
    chroot "$mount" /usr/bin/env -i "${environment[@]}" "${inside[@]}" "$@"
}

start() {
  isolated "${command[@]}" >>"$folder/service.log" 2>&1 &
  service=$!
  until_ready "$service"
}

until_ready() {
  local each
  for _ in $(seq $((2 * patience))); do
    for each in "$@"; do kill -0 "$each" 2>/dev/null || fail "it ended before it was ready"; done
    if curl --silent --fail --output /dev/null "http://127.0.0.1:$port/readyz"; then return; fi
    sleep 0.5
  done
  fail "not ready after $patience s"
}

end() {
  local first status=0
  first=$(pgrep -P "$1" | head -n 1)
  kill -TERM "$first"
  wait "$1" || status=$?
  [ "$status" = 0 ] || fail "SIGTERM ended it with status $status"
}

stop() {
  end "$service"
  service=""
}

listing() { find "$root" -xdev -printf '%p %y %s %T@ %m %u\n' | sort | sha256sum; }
ask() { curl --silent --show-error --fail --header "Authorization: Bearer $key" "http://127.0.0.1:$port$1"; }

calibrate() {
  # Send the photo and wait until it counts.
  local photo_id state=""
  photo_id=$(curl --silent --show-error --fail --header "Authorization: Bearer $key" --form "file=@$photo" \
    --form lens_maker=Check --form lens_model=Check --form lens_serial=container-1 --form aperture=5.6 \
    "http://127.0.0.1:$port/v1/photos" | python3 -c 'import json, sys; print(json.load(sys.stdin)["id"])')
  for _ in $(seq $((2 * patience))); do
    state=$(ask "/v1/jobs/$photo_id" | python3 -c 'import json, sys; print(json.load(sys.stdin)["state"])')
    case $state in
      succeeded) return ;;
      failed | cancelled) fail "the photo's job: $(ask "/v1/jobs/$photo_id")" ;;
    esac
    sleep 0.5
  done
  fail "the photo's job is still '$state' after $patience s"
}

before=$(listing)
say "without a key it does not start ..."
if (isolated "${command[@]}") >"$folder/refusal.log" 2>&1; then fail "it starts though nobody could use it"; fi
grep -q 'lensmodel keys create' "$folder/refusal.log" || fail "it does not say how to make a key: $folder/refusal.log"
key=$(isolated "${entry[@]}" keys create --owner check 2>>"$folder/service.log") || fail "keys create"
case $key in lpk_*) ;; *) fail "keys create printed no key" ;; esac

say "starting it: uid 10001, read-only root, process 1 ..."
start
first=$(pgrep -P "$service" | head -n 1)
[ "$(awk '/^Uid:/ { print $2 }' "/proc/$first/status")" = 10001 ] || fail "process 1 is not of uid 10001"
[ "$(awk '/^CapEff:/ { print $2 }' "/proc/$first/status")" = 0000000000000000 ] || fail "process 1 has capabilities"
if nsenter --target "$first" --mount --pid chroot "$mount" touch /opt/probe 2>/dev/null; then
  fail "the root is not read-only"
fi
[ "${#health[@]}" -gt 0 ] || fail "the image has no health check"
nsenter --target "$first" --mount --pid chroot "$mount" \
  /usr/bin/env -i "${environment[@]}" "${inside[@]}" "${health[@]}" || fail "its health check says no"

say "ready and healthy; uploading a photo ..."
[ "$(curl --silent --output /dev/null --write-out '%{http_code}' "http://127.0.0.1:$port/v1/photos")" = 401 ] \
  || fail "it answers somebody without a key"
calibrate

say "calibrated; stopping ..."
stop
[ "$(listing)" = "$before" ] || fail "something outside /data was written"
if grep -n 'Read-only file system' "$folder/service.log" >&2; then fail "it tried to write outside /data"; fi

say "starting again on the same volume ..."
start
photos=$(ask /v1/lenses | python3 -c 'import json, sys; print(sum(lens["photos"] for lens in json.load(sys.stdin)["items"]))')
[ "$photos" = 1 ] || fail "after a restart its lenses know $photos photos instead of 1"
stop

# --- the services of compose.yaml ----------------------------------------------------------------------------------

python=${PYTHON:-$here/.venv/bin/python}
if ls /usr/lib/postgresql/*/bin/initdb >/dev/null 2>&1 && "$python" -c 'import moto, flask' 2>/dev/null; then
  say "starting an API and a worker from it, on PostgreSQL and S3 ..."
  coproc SERVERS { PYTHONPATH=$here exec "$python" "$here/tests/app/servers.py" lensmodel; }
  while read -r line <&"${SERVERS[0]}"; do
    environment+=("$line")
    case $line in AWS_SECRET_ACCESS_KEY=*) break ;; esac
  done
  volume -api
  key=$(isolated "${entry[@]}" keys create --owner check 2>>"$folder/api.log") || fail "keys create on PostgreSQL"
  isolated "${entry[@]}" api --port "$port" >>"$folder/api.log" 2>&1 &
  api=$!
  volume -worker
  (inside=("${as_root[@]}") && isolated "${entry[@]}" worker) >>"$folder/worker.log" 2>&1 &
  worker=$!
  parts+=("$api" "$worker")
  until_ready "$api" "$worker"
  first=$(pgrep -P "$worker" | head -n 1)
  [ "$(awk '/^Uid:/ { print $2 }' "/proc/$first/status")" = 10001 ] || fail "the worker is not of uid 10001"
  ask /readyz | python3 -c 'import json, sys; sys.exit(not json.load(sys.stdin)["sandbox"]["account"])' \
    || fail "what decodes photos keeps the worker's user: $(ask /readyz)"
  calibrate
  end "$worker"
  end "$api"
  [ -z "$(find "$folder/data-api" "$folder/data-worker" -name '*.db')" ] || fail "a SQLite file beside PostgreSQL"
  eval "exec ${SERVERS[1]}>&-"
  wait "$SERVERS_PID" || true
  say "calibrated by two containers, whose rows lie in PostgreSQL and whose photos in S3"
else
  say "the services of compose.yaml were not tried: Debian's postgresql, or moto for $python, is missing"
fi

size=$(du --summarize --block-size=1M "$root" | cut -f1)
say "passed: built, ran and stopped; image $size MiB, of which the base $(du -sm --one-file-system "$folder/base" | cut -f1) MiB"
