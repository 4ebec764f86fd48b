"""What can be done in a history: an operator's commands and faults, each one a line of shell.

A new verb or fault is one new line here. $name is the dataflow, $unit its unit, $place the
directory of its project and notes, $device what its sink needs; the functions are those of
preamble.sh. The driver runs the same text that script.py prints, so that a person can do by hand
what the driver did.
"""

from dataclasses import dataclass
from enum import StrEnum

NO_TARGET = 3
"""Exit status of a fault that found nothing to hit; preamble.sh has it as well."""

CELLS = ("history-a", "history-b")
ALONE, VM, MACHINES = "container", "vm", "machines"
LABS = (ALONE, VM, MACHINES)
"""Where histories happen, see LAB in tests/lab/README.md."""


class Wish(StrEnum):
    """What a command that succeeds asks for."""

    NOTHING = ""
    RUN = "run"
    STOP = "stop"


@dataclass(frozen=True)
class Command:
    """An operator's command. wish: what it asks for. weight: how often it is drawn. lives: how many
    it may begin; a deploy that fails has what ran before run again. labs: where it is drawn; a
    dataflow over several machines is not deployed."""

    shell: str
    wish: Wish = Wish.NOTHING
    weight: int = 1
    is_for_all: bool = False
    lives: int = 0
    labs: tuple[str, ...] = LABS


@dataclass(frozen=True)
class Fault:
    """A fault. undo: takes it back before the next look. weight: how often it is drawn, 0 only as
    an answer to a command. kills_runner: the runner may be killed between a line and the note that
    it is written. labs: where it is drawn; not every one can have it."""

    shell: str
    undo: str = ""
    weight: int = 2
    kills_runner: bool = False
    labs: tuple[str, ...] = LABS


_OF_ONE, _OF_VM, _OF_MACHINES = (ALONE, VM), (VM,), (MACHINES,)
_FLAGS = (
    '--name $name --env "NOTES=$place/notes" --writable "$place/notes" --restart-policy on-failure'
)
_START = f'doractl start "$place/project/dataflow.yml" {_FLAGS}'
_DEPLOY = f'doractl deploy -q "$place/project/dataflow.yml" {_FLAGS} --soak 1s'
_DEPLOY_BROKEN = (
    'rm -rf "$place/broken"; cp -r "$place/project" "$place/broken" || exit 3; '
    'echo "raise SystemExit(1)" >"$place/broken/node.py"; '
    f'doractl deploy -q "$place/broken/dataflow.yml" {_FLAGS} --soak 1s'
)
# As a release by hand does it: another directory has the name, and its files have other contents.
_SWAP = (
    'rm -rf "$place/next"; cp -a "$place/project" "$place/next" || exit 3; '
    'echo "# edited" >>"$place/next/node.py"; '
    'mv "$place/project" "$place/before" || exit 3; '
    'mv "$place/next" "$place/project"; rm -r "$place/before"'
)

COMMANDS = {
    "start": Command(_START, Wish.RUN, 8, lives=1),
    "start-quick-grace": Command(f"{_START} --grace-duration 1s", Wish.RUN, 2, lives=1),
    "stop": Command("doractl stop $name", Wish.STOP, 3),
    "restart": Command("doractl restart $name", Wish.RUN, 3, lives=1),
    "systemctl-restart": Command("systemctl restart $unit", Wish.RUN, lives=1),
    "systemctl-stop": Command("systemctl stop $unit", Wish.STOP),
    "enable": Command("doractl enable $name"),
    "disable": Command("doractl disable $name"),
    "reload": Command("doractl reload $name", weight=2),
    "edit-reload": Command('echo "# edited" >>"$place/project/node.py"; doractl reload $name'),
    "set": Command("doractl set $name --hot-reload on", weight=2),
    "set-memory": Command("doractl set $name --memory-limit 3G"),
    "node-restart": Command("doractl node restart $name source", weight=2),
    "node-restart-sink": Command("doractl node restart $name sink", weight=2),
    "node-stop": Command("doractl node stop $name sink"),
    "node-stop-source": Command("doractl node stop $name source"),
    "run": Command(
        f'doractl run "$place/project/dataflow.yml" {_FLAGS} --stop-after 2s >/dev/null',
        Wish.STOP,
        lives=1,
    ),
    "deploy": Command(_DEPLOY, Wish.RUN, 3, lives=2, labs=_OF_ONE),
    "deploy-edited": Command(
        f'echo "# edited" >>"$place/project/node.py"; {_DEPLOY} --no-enable',
        Wish.RUN,
        lives=2,
        labs=_OF_ONE,
    ),
    "deploy-broken": Command(_DEPLOY_BROKEN, Wish.RUN, lives=2, labs=_OF_ONE),
    "rollback": Command("doractl rollback -q $name", Wish.RUN, 2, lives=2, labs=_OF_ONE),
    "releases": Command("doractl releases $name"),
    "inhibit": Command("doractl inhibit $name --why driving -- sleep 1"),
    "reset": Command("doractl reset $name"),
    "list": Command("doractl list", is_for_all=True),
    "why": Command("doractl why $name", weight=2),
    "logs": Command("doractl logs $name -n 5 --no-pager"),
    "show": Command("doractl show $name"),
    "export": Command("doractl export $name >/dev/null"),
    "up": Command("doractl up", is_for_all=True),
    "destroy": Command("doractl destroy", Wish.STOP, is_for_all=True),
}

FAULTS = {
    "kill-runner": Fault("hit KILL $(part runner)", kills_runner=True),
    "kill-coordinator": Fault("hit KILL $(part coordinator)"),
    "kill-daemon": Fault("hit KILL $(part daemon)"),
    "kill-source": Fault("hit KILL $(node source)"),
    "kill-sink": Fault("hit KILL $(node sink)"),
    "kill-launcher": Fault("hit KILL $(node source) && hit KILL $(launcher)"),
    "kill-unit": Fault("is_frozen && exit 3; systemctl kill -s KILL $unit", kills_runner=True),
    "freeze-unit": Fault("systemctl freeze $unit || exit 3", "thaw_unit"),
    "kill-doractl": Fault("hit KILL $(pgrep -x doractl)", weight=0),
    "kill-gateway": Fault("hit KILL $(main_pid dora-gateway.service)"),
    "stop-runner": Fault("hit STOP $(part runner)", "thaw", kills_runner=True),
    "stop-coordinator": Fault("hit STOP $(part coordinator)", "thaw"),
    "stop-daemon": Fault("hit STOP $(part daemon)", "thaw"),
    "stop-source": Fault("hit STOP $(node source)", "thaw"),
    "stop-doractl": Fault("hit STOP $(pgrep -x doractl)", "thaw", weight=0),
    "stop-gateway": Fault("hit STOP $(main_pid dora-gateway.service)", "thaw", 1),
    "node-exit-1": Fault("order sink exit1"),
    "node-exit-0": Fault("order source exit0", weight=1),
    "node-leaves-child": Fault("order sink leave-child"),
    "node-daemonises": Fault("order sink daemonise"),
    "node-floods": Fault("order sink flood", weight=1),
    "node-ignores": Fault("order sink ignore", weight=1),
    "device-unplugged": Fault(
        'rm "$device" && hit KILL $(node sink); sleep 1; touch "$device"',
    ),
    "journald-restarts": Fault("systemctl restart systemd-journald.service"),
    "bus-hangs": Fault("hit STOP $(main_pid dbus.service) && sleep 2; thaw", weight=1),
    "logind-restarts": Fault("systemctl restart systemd-logind.service", weight=1),
    "daemon-reload": Fault("systemctl daemon-reload"),
    "daemon-reexec": Fault("systemctl daemon-reexec"),
    "run-full": Fault("fill_run", "empty_run", 1),
    "project-deleted": Fault(
        'mv "$place/project" "$place/deleted"', 'mv "$place/deleted" "$place/project"'
    ),
    "project-swapped": Fault(_SWAP),
    "project-read-only": Fault(
        # A step beside this one may just put another directory in its place.
        'mount --bind "$place/project" "$place/project" || exit 3; '
        'mount -o remount,bind,ro "$place/project"',
        'mountpoint -q "$place/project" && umount -l "$place/project"',
    ),
    "directory-deleted": Fault('rm -r "/run/dora-systemd/$name"', weight=1),
    "clock-forward": Fault("clock +1 hour", "clock -1 hour", labs=_OF_VM),
    "clock-to-new-year": Fault("clock +60 days", "clock -60 days", 1, labs=_OF_VM),
    "memory-full": Fault("fill_memory", labs=_OF_VM),
    "cable-out": Fault("unplug off 2", "plug", 5, labs=_OF_MACHINES),
    "cable-out-long": Fault("unplug off 12", "plug", 7, labs=_OF_MACHINES),
    "cable-mute": Fault("unplug mute 12", "plug", 5, labs=_OF_MACHINES),
    "kill-link": Fault("hit KILL $(link)", weight=5, labs=_OF_MACHINES),
    "kill-member": Fault(
        'there "systemctl kill --signal=KILL $unit" || exit 3', "", 5, True, _OF_MACHINES
    ),
    "kill-member-daemon": Fault(
        "there \"pkill -KILL -f 'dora [d]aemon'\" || exit 3", weight=5, labs=_OF_MACHINES
    ),
    "kill-member-sink": Fault(
        "there \"pkill -KILL -f '[n]ode.py sink'\" || exit 3", weight=5, labs=_OF_MACHINES
    ),
    "stop-member-runner": Fault("freeze_member", "thaw_member", 5, True, _OF_MACHINES),
}


@dataclass(frozen=True)
class Step:
    """One step: a key of COMMANDS or FAULTS, or LOOK. pause_ms: how long the driver does nothing
    before it. is_joined: it begins while the one before still runs."""

    what: str
    cell: str = CELLS[0]
    pause_ms: int = 0
    is_joined: bool = False


LOOK = "look"
"""Undo the faults, wait until nothing changes any more, and ask everyone what there is."""


def shell_of(what: str) -> str:
    """The text that carries out a step."""
    return COMMANDS[what].shell if what in COMMANDS else FAULTS[what].shell
