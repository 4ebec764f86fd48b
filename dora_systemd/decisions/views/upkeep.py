"""What else happens to a machine: core dumps, upgrades that reboot it, its shutdown. Pure."""

import re
from collections.abc import Iterator, Mapping

from dora_systemd.decisions.cell.core_dumps import keeps_core_dumps
from dora_systemd.decisions.views.findings import Finding, State
from dora_systemd.values import format_duration

_APPORT = r"\|\S*/apport(?:\s|$)"
_ASSIGNMENT = re.compile(r"^[ \t]*(\w+)[ \t]*=(.*)$", re.M)
_NONE = ("0", "0K", "0M", "0G", "0B")
_INSTALL = "as root: apt install systemd-coredump"
_COMMENT = re.compile(r"""("(?:[^"\\]|\\.)*")|//[^\n]*|/\*.*?\*/|^[ \t]*#[^\n]*""", re.S | re.M)
_REBOOT = re.compile(r"Unattended-Upgrade::Automatic-Reboot(-Time)?\s*\"([^\"]*)\"\s*;", re.I)
_PERIODIC = re.compile(r"APT::Periodic::Unattended-Upgrade\s*\"([^\"]*)\"\s*;", re.I)
_BLOCKS = re.compile(r"Unattended-Upgrade\s*\{([^{}]*)\}\s*;?", re.I)
_YES = ("1", "true", "yes", "on", "enable", "with")
_ANY_TIME = "now"


def judge_core_pattern(
    pattern: str, is_there: bool = True, config: str = "", is_container: bool = False
) -> Finding:
    """Judge whether `why` and `coredumpctl` show a crash of a node.

    pattern: see kernel.core_pattern. is_there: whether the program in the pattern exists. config:
    of coredump.conf(5), in its order. is_container: the kernel is another system's.
    """
    pattern = pattern.strip()
    if is_container:
        text = "a crash of a node has no stack here: the core dumps of a container go to its host"
        return Finding("core dumps", State.NOTE, text, "coredumpctl on its host")
    if keeps_core_dumps(pattern):
        return _judge_coredump(is_there, config)
    if re.match(_APPORT, pattern):
        text = "apport takes the core dumps of nodes, and discards those of programs of no package"
        remedy = f"{_INSTALL}; systemctl disable --now apport"
        return Finding("core dumps", State.NOTE, text, remedy)
    where = f"kernel.core_pattern is {pattern}" if pattern else "kernel.core_pattern is empty"
    text = f"a node that crashes leaves no core dump for why and coredumpctl: {where}"
    return Finding("core dumps", State.NOTE, text, _INSTALL)


def _judge_coredump(is_there: bool, config: str) -> Finding:
    """Judge whether systemd-coredump is installed, and may process core dumps."""
    if not is_there:
        text = "kernel.core_pattern names systemd-coredump, which is not installed"
        return Finding("core dumps", State.NOTE, text, _INSTALL)
    values = {key: text.strip() for key, text in _ASSIGNMENT.findall(config)}
    if values.get("ProcessSizeMax", "") in _NONE:
        text = "ProcessSizeMax= in coredump.conf(5) is 0: a crash of a node has no stack"
        return Finding("core dumps", State.NOTE, text, "as root: remove that line")
    return Finding("core dumps", State.OK, "why and coredumpctl show where a node has crashed")


def judge_reboots(config: str) -> Iterator[Finding]:
    """Warn of unattended upgrades that reboot the machine. config: of apt, in its order."""
    text = _COMMENT.sub(lambda found: found[1] or "", config)
    text = _BLOCKS.sub(_unfolded, text)
    periodic = _PERIODIC.findall(text)
    found = {"": "", "-Time": _ANY_TIME} | {
        key.title(): value for key, value in _REBOOT.findall(text)
    }
    if not periodic or periodic[-1] in ("", "0") or found[""].lower() not in _YES:
        return
    when = found["-Time"]
    at = "as soon as they are done" if when == _ANY_TIME else f"at {when[:8]}"
    text = f"unattended upgrades may reboot this machine {at}, whatever runs"
    remedy = 'as root: set Unattended-Upgrade::Automatic-Reboot "false"; in the last file of '
    yield Finding("upgrades", State.WARNING, text, f"{remedy}/etc/apt/apt.conf.d")


def judge_stops(stops: Mapping[str, int], allowed: int) -> Iterator[Finding]:
    """Warn of dataflows of a user that a shutdown would kill while they stop.

    stops: how long the stop of each may take, by name. allowed: how long systemd waits for all
    services of the user. Both in µs.
    """
    for name, needed in sorted(stops.items()):
        if allowed and needed > allowed:
            times = f"{format_duration(needed)}, and a shutdown waits {format_duration(allowed)}"
            text = f"the stop of {name} may take {times} for all services of a user"
            remedy = "as root: systemctl edit user@.service, [Service] TimeoutStopSec="
            yield Finding("stop", State.WARNING, text, remedy + format_duration(needed))


def _unfolded(block: re.Match[str]) -> str:
    """Write `Unattended-Upgrade { KEY "VALUE"; };` with a full name for each key."""
    return re.sub(r"(^|;)\s*(?=[A-Za-z])", r"\1 Unattended-Upgrade::", block[1].strip())
