"""What doctor finds about real time."""

import pytest

from dora_systemd.decisions.views.findings import (
    Place,
    RealTime,
    State,
    judge_cpuset,
    judge_journal,
    judge_real_time,
    storage_of,
)


@pytest.mark.parametrize(
    ("facts", "state", "words"),
    [
        (RealTime(), State.OK, "if root gives it"),
        (RealTime(has_groups=True, is_granted=True), State.NOTE, "CONFIG_RT_GROUP_SCHED"),
        (RealTime(is_granted=True, can_raise=True), State.OK, "if root gives it"),
        (RealTime(has_groups=True), State.NOTE, "CONFIG_RT_GROUP_SCHED"),
        (RealTime(has_groups=True, is_granted=False), State.NOTE, "CONFIG_RT_GROUP_SCHED"),
        (RealTime(has_groups=False, is_granted=False), State.NOTE, "even to root"),
    ],
)
def test_scheduling(facts: RealTime, state: State, words: str) -> None:
    (finding,) = judge_real_time(facts)
    assert (finding.topic, finding.state) == ("real time", state)
    assert words in finding.text
    assert bool(finding.remedy) == (state is not State.OK)


def test_a_container_without_the_capability() -> None:
    for is_granted in (None, True):  # chrt(1) by root needs no limit, a node does
        facts = RealTime(is_granted=is_granted, can_raise=False)
        scheduling, rights = judge_real_time(facts)
        assert (scheduling.topic, scheduling.state) == ("real time", State.NOTE)
        assert "cannot start" in scheduling.text
        assert "CAP_SYS_RESOURCE" in scheduling.remedy
        assert (rights.topic, rights.state) == ("rights", State.NOTE)
    assert len(list(judge_real_time(RealTime(can_raise=True)))) == 1


def test_what_slows_down() -> None:
    facts = RealTime(isolated="2-3", governors=("performance", "powersave"))
    _, isolated, governor = judge_real_time(facts)
    assert isolated.text == "cpus 2-3 run only what is bound to them"
    assert "(powersave)" in governor.text
    assert len(list(judge_real_time(RealTime(governors=("performance",))))) == 1


def test_cpusets() -> None:
    assert judge_cpuset({"cpu", "cpuset"}, is_user=True).state is State.OK
    assert "Delegate=cpu cpuset" in judge_cpuset({"cpu"}, is_user=True).remedy
    assert "container" in judge_cpuset({"cpu"}, is_user=False).remedy


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
