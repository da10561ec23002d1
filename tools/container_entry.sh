#!/bin/sh
# The entry of the container: `lensmodel` as user 10001, which every process of ours is from here on.
#
# Who starts the container as root (`--user 0`) lets a worker have what decodes photos become a third user,
# lens-task (10002), who owns no file and no process of the service. For that it keeps the capabilities to change
# to another user and to end its processes, and no others.
set -eu

if [ "$(id -u)" = 0 ]; then
  kept=-all,+setuid,+setgid,+kill
  exec setpriv --reuid=10001 --regid=10001 --groups=10001,10002 --inh-caps="$kept" --ambient-caps="$kept" \
    --no-new-privs -- "$0" "$@"
fi
mkdir -p /data/tmp
exec lensmodel "$@"
