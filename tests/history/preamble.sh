# The words of the steps, for the driver of tests/history and for the scripts that it prints.
# WORK: a directory of the whole history. NO_TARGET, 3: there was nothing to hit.

tree=/sys/fs/cgroup
[ -e $tree/cgroup.controllers ] || tree=$tree/unified

# of NAME: choose the dataflow that the next lines are about
of() { name=$1 unit=dora-$1.service place=$WORK/$1 device=/run/history-devices/$1; }

group() { echo "$tree$(systemctl show -P ControlGroup "$unit")"; }
main_pid() { systemctl show -P MainPID "$1" | grep -vx 0; }
has() { tr '\0' ' ' <"/proc/$1/cmdline" 2>/dev/null | grep -q -- "$2"; }

# part runner|coordinator|daemon: its pid
part() {
    [ "$1" = runner ] && word="-m dora_systemd.runner" || word="dora $1"
    for pid in $(cat "$(group)/supervisor/cgroup.procs" 2>/dev/null); do
        has "$pid" "$word" && echo "$pid"
    done
}

# node ID: its processes
node() { cat "$(group)/node-$1/cgroup.procs" 2>/dev/null; }

# launcher: a process that has not become a node yet; looks for one a thousand times
launcher() {
    for _ in $(seq 1000); do
        pgrep -f "[l]auncher.pl" | head -1 | grep . && return
    done
}

began() { sed 's/.*) //' "/proc/$1/stat" 2>/dev/null | cut -d' ' -f20; }

# hit SIGNAL PID...: thaw continues what STOP has stopped. systemd 257 hangs when the main process
# of a frozen unit dies, since it starts ExecStopPost= in the frozen group.
hit() {
    signal=$1; shift
    [ $# -gt 0 ] && ! is_frozen || return 3
    for pid; do
        [ "$signal" = STOP ] && echo "$pid $(began "$pid")" >>"$WORK/frozen"
        kill -s "$signal" "$pid" 2>/dev/null
    done
    return 0
}

thaw() {
    [ -e "$WORK/frozen" ] || return 0
    while read -r pid when; do
        [ "$(began "$pid")" = "$when" ] && kill -s CONT "$pid"
    done <"$WORK/frozen"
    rm "$WORK/frozen"
}

is_frozen() { [ "$(systemctl show -P FreezerState "$unit")" != running ]; }

thaw_unit() { systemctl thaw "$unit" 2>/dev/null; return 0; }

# order ROLE WORD: a node of tests/system/faults/node.py does something by itself
order() {
    [ -n "$(node "$1")" ] || return 3
    touch "$WORK/draft" && chmod 666 "$WORK/draft" && mv "$WORK/draft" "$place/notes/order.$1.$2"
}

# fill_run: /run gets no larger than it is, until empty_run
fill_run() {
    [ "$(findmnt -no FSTYPE /run)" = tmpfs ] || return 3
    [ -e "$WORK/run_size" ] || findmnt -no SIZE -b /run >"$WORK/run_size"
    mount -o "remount,size=$(($(findmnt -no USED -b /run) + 8192))" /run
}

empty_run() {
    [ -e "$WORK/run_size" ] || return 0
    mount -o "remount,size=$(cat "$WORK/run_size")" /run && rm "$WORK/run_size"
}

# clock HOW MUCH: the clock jumps
clock() { date -s "@$(date -d "now $*" +%s.%N)" >/dev/null; }

# fill_memory: a process takes all there is, until the kernel kills that one
fill_memory() {
    systemd-run --quiet --wait --property=OOMScoreAdjust=1000 \
        /usr/bin/python3 -c 'kept = []
while True: kept.append(b"x" * 2**24)'
    return 0
}

# there COMMAND: on the second machine
there() { ssh -oBatchMode=yes -oConnectTimeout=2 b "$@"; }

link() { main_pid "doralink-$name:b.service"; }

# cable off|mute|on: that of the second machine, see tests/lab/machines.py
cable() {
    python3 -c 'import socket, sys
lab = socket.socket(socket.AF_UNIX)
lab.connect("/lab/control")
lab.sendall(f"cable b {sys.argv[1]}\n".encode())
answer = lab.makefile().readline()
sys.exit(answer != "ok\n" and answer)' "$1"
}

# unplug off|mute SECONDS
unplug() { cable "$1" && sleep "$2" && plug; }

plug() { cable on && until there true; do sleep 0.1; done; }

# freeze_member: the runner there, until thaw_member
freeze_member() { there "pkill -STOP -f 'dora_systemd[.]runner'" || return 3; }

thaw_member() { there "pkill -CONT -f 'dora_systemd[.]runner'"; return 0; }
