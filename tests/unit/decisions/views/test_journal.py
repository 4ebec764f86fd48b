"""Where journald keeps its records, as doctor tells it."""

import pytest

from dora_systemd.decisions.views.findings import State
from dora_systemd.decisions.views.journal import Place, judge_journal, storage_of


@pytest.mark.parametrize(
    ("place", "storage", "words", "remedy"),
    [
        (Place.DISK, "auto", "it survives a reboot", ""),
        (Place.DISK, "persistent", "it survives a reboot", ""),
        (Place.DISK, "none", "keeps nothing once it is restarted", "Storage=persistent"),
        (Place.DISK, "volatile", "in memory only once it is restarted", "Storage=persistent"),
        (Place.MEMORY, "volatile", "lost at a reboot", "Storage=persistent"),
        (Place.MEMORY, "auto", "lost at a reboot", "mkdir"),
        (Place.MEMORY, "persistent", "lost at a reboot", "--flush"),
        (Place.NOWHERE, "none", "no line is kept: journald has Storage=none", "Storage=persistent"),
        (Place.NOWHERE, "auto", "no line since it was started", "restart"),
        (Place.STOPPED, "auto", "does not run", "start"),
    ],
)
def test_places(place: Place, storage: str, words: str, remedy: str) -> None:
    finding = judge_journal(place, storage)
    assert finding.topic == "journal"
    assert words in finding.text
    assert remedy in finding.remedy
    assert finding.state is (State.WARNING if remedy else State.OK)


def test_what_nobody_can_tell_is_not_ok() -> None:
    assert judge_journal(Place.UNKNOWN, "auto").state is State.NOTE


@pytest.mark.parametrize(
    ("config", "storage"),
    [
        ("", "auto"),
        ("# Storage=none\n#Storage=none\n", "auto"),
        ("Storage=none\n[Journal]\nStorage = volatile \n", "volatile"),
        ("Storage=volatile\nStorage=x\n", "volatile"),
    ],
)
def test_the_last_storage_counts(config: str, storage: str) -> None:
    assert storage_of(config) == storage
