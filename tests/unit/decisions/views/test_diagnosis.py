"""What doctor makes of its facts."""

import pytest

from dora_systemd.decisions.views.diagnosis import (
    Process,
    judge_controllers,
    judge_port,
    judge_processes,
    judge_properties,
    judge_rate,
    judge_systemd,
)
from dora_systemd.decisions.views.findings import (
    Finding,
    State,
    finding_values,
    format_findings,
    has_problem,
)

CELL = "/dora.slice/dora-robot.service/supervisor"
USER_CELL = "/user.slice/user-1000.slice/user@1000.service/dora.slice/dora-a.service/node-x"


@pytest.mark.parametrize(
    ("version", "state", "part"),
    [
        ("257.13-1~deb13u1", State.OK, "257.13"),
        ("252.39-1~deb12u1", State.NOTE, "properties, see the end"),
        ("256", State.NOTE, "lacks"),
        ("251", State.PROBLEM, "too old"),
        ("devel", State.NOTE, "lacks"),
    ],
)
def test_systemd(version: str, state: State, part: str) -> None:
    found = judge_systemd(version)
    assert found.state is state
    assert part in found.text


@pytest.mark.parametrize(
    ("version", "names"),
    [
        ("252.39-1~deb12u1", ["DelegateSubgroup", "RestartSteps", "PrivatePIDs"]),
        ("256", ["PrivatePIDs"]),
        ("257.13-1~deb13u1", []),
        ("251", []),  # which is a problem of its own
        ("", []),
    ],
)
def test_properties_that_systemd_lacks(version: str, names: list[str]) -> None:
    found = list(judge_properties(version))
    assert len(found) == bool(names)
    for one in found:
        assert one.state is State.NOTE
        assert set(names) <= set(one.text.replace(",", "").split())


def test_an_old_systemd_needs_two_lines_of_a_small_terminal() -> None:
    """The finding fits into two lines of 80 columns, also where another topic is long."""
    both = [judge_systemd("252.39-1~deb12u2"), Finding("port 53290", State.OK, "free")]
    assert len(format_findings(both, 80).splitlines()) == 3


def test_controllers() -> None:
    assert judge_controllers({"cpu", "memory", "pids", "io", "cpuset"}, False).state is State.OK
    found = judge_controllers({"memory", "pids"}, True)
    assert found.state is State.WARNING
    assert "CPU, I/O" in found.text
    assert "Delegate=" in found.remedy
    assert judge_controllers({"cpu", "memory", "pids"}, True).state is State.NOTE
    assert judge_controllers({"cpu", "memory", "pids"}, False).state is State.WARNING


@pytest.mark.parametrize(
    ("config", "is_user", "state", "part"),
    [
        ("", False, State.OK, "10000 lines in 30s"),
        ("#RateLimitBurst=5\n", True, State.NOTE, "10000 lines in 30s"),
        ("RateLimitBurst=5\n RateLimitIntervalSec=1min\n", True, State.NOTE, "5 lines in 1min"),
        ("RateLimitBurst=5\nRateLimitBurst=\n", True, State.NOTE, "10000"),
        ("RateLimitBurst=\nStorage=volatile\n", True, State.NOTE, "10000 lines in 30s"),
        ("RateLimitBurst=0\n", True, State.OK, "no rate limit"),
        ("RateLimitIntervalSec=0\n", True, State.OK, "no rate limit"),
        ("RateLimitIntervalSec=x\n", True, State.NOTE, "in x "),
    ],
)
def test_rate(config: str, is_user: bool, state: State, part: str) -> None:
    found = judge_rate(config, is_user)
    assert found.state is state
    assert part in found.text


def test_port() -> None:
    owner = Process(7, 1, ("dora", "coordinator"))
    assert judge_port(6013, [], False).state is State.OK
    assert "another user" in judge_port(6013, [], True).text
    assert "process 7 (dora coordinator)" in judge_port(6013, [owner], True).text


def texts(*processes: Process) -> list[str]:
    return [one.text for one in judge_processes(processes) if one.state is not State.OK]


DAEMON = Process(10, 1, ("/usr/bin/python3", "/usr/bin/dora", "daemon", "--x"))
NODE = Process(11, 10, ("python", "node.py"), is_node=True)


def test_bare_dora() -> None:
    assert texts(DAEMON, NODE) == [
        "process 10 (/usr/bin/python3 /usr/bin/dora daemon --x) belongs to no dataflow of doractl"
    ]


def test_orphans() -> None:
    child = Process(12, 11, ("helper",), is_node=True)
    assert texts(NODE, child) == ["process 11 (python node.py) is a node whose daemon is gone"]


@pytest.mark.parametrize("group", [CELL, USER_CELL])
def test_what_is_ours_is_none_of_it(group: str) -> None:
    ours = [Process(one.pid, one.parent, one.command, group, one.is_node) for one in (DAEMON, NODE)]
    assert texts(*ours) == []
    (found,) = judge_processes(ours)
    assert found.state is State.OK


@pytest.mark.parametrize(
    ("command", "engine"),
    [
        (("dora", "coordinator"), "coordinator"),
        (("python3", "-u", "/opt/bin/dora", "daemon"), "daemon"),
        (("dora", "list"), ""),
        (("vim", "dora"), ""),
        (("grep", "daemon"), ""),
        ((), ""),
    ],
)
def test_engines(command: tuple[str, ...], engine: str) -> None:
    assert Process(1, 0, command).engine == engine


def test_a_long_command_is_cut() -> None:
    assert len(str(Process(1, 0, ("x" * 500,)))) < 100


FINDINGS = [
    Finding("dora", State.OK, "version 1.1.0"),
    Finding("journal", State.WARNING, "it is volatile", "mkdir it"),
]


def test_what_is_printed_on_a_narrow_terminal() -> None:
    found = Finding("dora", State.NOTE, "one two three", "run /usr/bin/x y")
    assert format_findings([found], 25).splitlines() == [
        "note     dora  one two",
        "               three",
        "               -> run",
        "                  /usr/bin/x",
        "                  y",
    ]


def test_what_is_printed() -> None:
    assert format_findings(FINDINGS) == (
        "ok       dora     version 1.1.0\n"
        "warning  journal  it is volatile\n"
        "                  -> mkdir it"
    )
    assert finding_values(FINDINGS[1]) == {
        "topic": "journal",
        "state": "warning",
        "text": "it is volatile",
        "remedy": "mkdir it",
    }


def test_problems() -> None:
    assert not has_problem(FINDINGS)
    assert has_problem([*FINDINGS, Finding("x", State.PROBLEM, "y")])
