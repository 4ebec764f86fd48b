#!/bin/sh
# What dora's daemon executes in place of a node. Being the node's process before the node is, it
# puts the node into its group and its output into our pipes without a race: whatever the node
# does, it does there. The rest of the environment is for dora's daemon and not for the node.
#
# launcher.sh NODE DIRECTORY pipe|keep COMMAND [ARGUMENT...]
#   pipe: stdout and stderr become the node's FIFOs; opening them waits for the runner.
#   keep: dora itself reads the output (send_stdout_as, send_logs_as).
# From the environment: DORA_SYSTEMD_CELL (RuntimeDirectory), DORA_SYSTEMD_GROUP (cgroup of the
# unit), DORA_SYSTEMD_LIBEXEC (first entry of PATH), DORA_SYSTEMD_UNSET (names).
set -eu
node=$1 directory=$2 output=$3
shift 3
echo $$ >"$DORA_SYSTEMD_CELL/io/$node.pid"
if [ "$output" = pipe ]; then
    exec >"$DORA_SYSTEMD_CELL/io/$node.out" 2>"$DORA_SYSTEMD_CELL/io/$node.err"
fi
echo 0 >"$DORA_SYSTEMD_GROUP/node-$node/cgroup.procs"
cd -- "$directory"
PATH=${PATH#"$DORA_SYSTEMD_LIBEXEC:"}
# Who configures zenoh himself has the say; dora refuses both at once, and a file it cannot read.
if [ -z "${ZENOH_CONFIG+set}${DORA_ZENOH_CONFIG_OVERLAY+set}" ] && [ -r "${0%/*}/zenoh.json5" ]; then
    export DORA_ZENOH_CONFIG_OVERLAY="${0%/*}/zenoh.json5"
fi
# shellcheck disable=SC2086 # a list of names
unset $DORA_SYSTEMD_UNSET DORA_SYSTEMD_UNSET DORA_SYSTEMD_CELL DORA_SYSTEMD_GROUP \
    DORA_SYSTEMD_LIBEXEC DORA_SYSTEMD_DIRECTORY DORA_SYSTEMD_PYTHON DORA_SYSTEMD_KEEP
exec "$@"
