"""What `doractl doctor` says about where journald keeps its records. Pure."""

import re
from enum import StrEnum

from dora_systemd.decisions.views.findings import Finding, State

TOPIC = "journal"
_NEVER, _MEMORY, _DEFAULT = "none", "volatile", "auto"
_WORDS = (_NEVER, _MEMORY, _DEFAULT, "persistent")
_KEEP = (
    "as root: set Storage=persistent in journald.conf(5), then systemctl restart systemd-journald"
)


class Place(StrEnum):
    """Where journald has written since it was started."""

    DISK = "disk"
    MEMORY = "memory"
    NOWHERE = "nowhere"
    STOPPED = "stopped"
    """It does not run."""
    UNKNOWN = "unknown"


def assigned(config: str, keys: str) -> list[tuple[str, str]]:
    """The keys and values of journald.conf and its drop-ins, in their order. keys: a pattern."""
    return re.findall(rf"^[ \t]*({keys})[ \t]*=[ \t]*(\S*)", config, flags=re.M)


def storage_of(config: str) -> str:
    """The Storage= of journald. config: journald.conf and its drop-ins, in their order."""
    # journald ignores a word that it does not know.
    words = [word for _, word in assigned(config, "Storage") if word in _WORDS]
    return words[-1] if words else _DEFAULT


def judge_journal(place: Place, storage: str) -> Finding:
    """One finding: whether what is written now is still there after a reboot.

    Files alone prove nothing: those of an earlier Storage= stay where they are.
    """
    if place is Place.UNKNOWN:
        text = "without the system's systemd nobody can tell whether it survives a reboot"
        return Finding(TOPIC, State.NOTE, text)
    if place is Place.STOPPED:
        text = "systemd-journald does not run: no line is kept"
        remedy = "as root: systemctl start systemd-journald; systemctl unmask it if it is masked"
        return Finding(TOPIC, State.WARNING, text, remedy)
    if place is Place.NOWHERE:
        return _kept_nowhere(storage)
    if place is Place.MEMORY:
        text = "it is kept in memory and lost at a reboot"
        return Finding(TOPIC, State.WARNING, text, _way_to_disk(storage))
    if storage in (_NEVER, _MEMORY):
        loss = "keeps nothing" if storage == _NEVER else "keeps it in memory only"
        text = f"with Storage={storage}, systemd-journald {loss} once it is restarted"
        return Finding(TOPIC, State.WARNING, text, _KEEP)
    return Finding(TOPIC, State.OK, "it survives a reboot")


def _kept_nowhere(storage: str) -> Finding:
    if storage == _NEVER:
        text = "no line is kept: journald has Storage=none"
        return Finding(TOPIC, State.WARNING, text, _KEEP)
    text = "systemd-journald has kept no line since it was started"
    remedy = "as root: systemctl restart systemd-journald; its systemctl status tells of errors"
    return Finding(TOPIC, State.WARNING, text, remedy)


def _way_to_disk(storage: str) -> str:
    if storage in (_NEVER, _MEMORY):
        return _KEEP
    if storage == _DEFAULT:
        return "as root: mkdir -p /var/log/journal and systemctl restart systemd-journald"
    return "as root: journalctl --flush; if that changes nothing, can /var/log/journal be written?"
