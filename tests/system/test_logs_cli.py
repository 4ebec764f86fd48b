"""doractl logs with a real journal."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from dora_systemd.decisions.logs.journal_events import EVENTS
from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, journalctl, run, sync_journal, wait_for
from tests.system.terminal import shown

TALK = """
import sys
from dora import Node
node = Node()
for i in range(5):
    print("line", i, flush=True)
print("on stderr", file=sys.stderr, flush=True)
node.log("error", "a bad thing")
node.log("debug", "a detail")
node.log("trace", "a tiny detail")
for event in node:
    if event["type"] == "INPUT":
        print("tick", flush=True)
"""
FLOW = """
nodes:
  - {id: cam-left, path: talk.py, inputs: {tick: dora/timer/millis/100}}
  - {id: cam-right, path: talk.py, inputs: {tick: dora/timer/millis/100}}
"""

pytestmark = pytest.mark.warns("a bad thing")
UUID = "12345678-e29b-41d4-a716-446655440000"


def start_talking(cell: Cell, project: Project) -> Cell:
    project.write("talk.py", TALK)
    cell.start(project.write("dataflow.yml", FLOW))
    for node in ("cam-left", "cam-right"):
        wait_for("ticks", lambda node=node: "tick" in cell.messages(node))  # type: ignore[misc]
    sync_journal()
    return cell


@pytest.fixture
def talking(cell: Cell, project: Project) -> Cell:
    return start_talking(cell, project)


@pytest.fixture(scope="class")
def talks(class_cell: Cell, class_project: Project) -> Cell:
    """The same for tests that end and restart nothing."""
    return start_talking(class_cell, class_project)


def logs(cell: Cell, *arguments: str, check: bool = True) -> list[str]:
    return cell.doractl("logs", *arguments, check=check).stdout.splitlines()


def messages(cell: Cell, *arguments: str) -> list[str]:
    return logs(cell, cell.name, "-o", "cat", *arguments)


def test_repetitions_on_a_terminal(talking: Cell) -> None:
    """A pipe gets every line, and people how often it came."""
    wait_for("ticks", lambda: talking.messages("cam-left").count("tick") > 5)
    talking.systemctl("stop")
    sync_journal()
    words = ("logs", talking.name, "--node", "cam-left", "--grep", "^tick$", "--no-pager")
    ticks = messages(talking, "--node", "cam-left").count("tick")
    text = re.sub(r"\x1b\[[0-9;:]*m", "", shown("doractl", talking.scope.flag, *words))
    said = [line.partition(" cam-left ")[2].strip() for line in text.splitlines()]
    assert said.count("tick") == 1
    assert f"... the same line, {ticks} times in all" in said


def test_journalctl_shows_the_same(talking: Cell) -> None:
    talking.systemctl("stop")
    sync_journal()
    ours = logs(talking, talking.name, "--node", "cam-left")
    assert journalctl("-t", f"{talking.name}/cam-left").splitlines() == ours
    unit = "_SYSTEMD_USER_UNIT" if talking.scope.is_user else "_SYSTEMD_UNIT"
    fields = (f"{unit}={talking.unit}", "DORA_NODE=cam-left")
    assert journalctl(*fields).splitlines() == ours


def test_runs_and_selectors(talking: Cell) -> None:
    uuid = talking.journal("DORA_EVENT=dataflow-started")[0]["DORA_DATAFLOW"]
    first_run = talking.journal("DORA_EVENT=dataflow-started")[0]["DORA_RUN"]
    talking.systemctl("restart")
    talking.systemctl("stop")
    starting = f"Dataflow {talking.name} is starting"
    assert messages(talking, "--events").count(starting) == 2
    for which in ("CURRENT", "PREVIOUS"):
        assert messages(talking, "--events", "--run", which).count(starting) == 1
    previous = messages(talking, "--run", "PREVIOUS")
    assert messages(talking, "--run", first_run) == [text for text in previous if text != starting]
    everything = messages(talking)
    for selector in (uuid, uuid[:13], talking.unit):
        assert logs(talking, selector, "-o", "cat") == everything
    assert logs(talking, "-o", "cat", "--tail", "3") == everything[-3:]


def test_follow(talking: Cell) -> None:
    command = ["doractl", talking.scope.flag, "logs", talking.name, "-f", "-o", "cat"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout
        lines = [child.stdout.readline() for _ in range(20)]
        talking.systemctl("restart")
        while "is starting" not in (line := child.stdout.readline()):
            assert line
        child.terminate()
    assert lines.count("tick\n") > 5


UNTIL_END = ["--until-end", "--tail", "1", "--grep", "is starting|finished|stopped|^tick"]


def test_follow_until_the_end(talking: Cell) -> None:
    """A restart is no end, and every line is there once, the last one too."""
    command = ["doractl", talking.scope.flag, "logs", talking.name, "-o", "json", *UNTIL_END]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout
        lines = [child.stdout.readline()]
        talking.systemctl("restart")
        while "is starting" not in lines[-1]:
            lines.append(child.stdout.readline())
            assert lines[-1]
        talking.systemctl("stop")
        lines += child.stdout.readlines()
        assert child.wait() == 0
    seen = [json.loads(line) for line in lines]
    assert seen[-1]["DORA_EVENT"] == "dataflow-stopped"
    since = ("--since", f"@{int(seen[0]['__REALTIME_TIMESTAMP']) / 1e6:.6f}")
    again = logs(talking, talking.name, "-o", "json", *UNTIL_END[-2:], *since)
    cursors = [json.loads(line)["__CURSOR"] for line in again]
    assert [one["__CURSOR"] for one in seen] == cursors[cursors.index(seen[0]["__CURSOR"]) :]


def test_until_the_end_of_what_does_not_run(talking: Cell) -> None:
    talking.systemctl("stop")
    sync_journal()
    shown = messages(talking, "--until-end", "--tail", "3")
    assert shown == messages(talking, "--tail", "3")
    assert messages(talking, "--until-end") == messages(talking, "--tail", "10")


BAD_INPUT = [
    (["{name}", "--node", "cam"], 4, "cannot find a node 'cam'", "cam-left, cam-right"),
    (["{name}x"], 4, "no dataflow named ", "did you mean"),
    (["{name}", "--since", "foo"], 2, "cannot read the time: foo", "systemd.time(7)"),
    (["{name}", "--level", "loud"], 2, "cannot use 'loud' as a level", "error, warn"),
    (["{name}", "--grep", "("], 2, "cannot use the pattern", ""),
    (["{name}", "--run", "PREVIOUS"], 4, "cannot find the previous run", "--run ALL"),
    (["--until-end"], 2, "cannot wait for the end of all dataflows", "doractl logs NAME"),
    (["{name}", "-r", "--until-end"], 2, "cannot follow with the newest", "--reverse"),
    (["--node", "cam-left"], 2, "cannot select nodes of all dataflows", ""),
    (["{name}", "-o", "yaml"], 2, "invalid value for '-o'", ""),
    (["{name}", "--tail", "-1"], 2, "cannot use '-1' as a number of lines", "such as 100"),
    (["{name}", "-n", "1 2"], 2, "cannot use '1 2' as a number of lines", "such as 100"),
    (["{name}", "--log-filter", "cam"], 2, "cannot read 'cam' as a log filter", "NODE=LEVEL"),
    (["{name}", "--log-filter", "a=loud"], 2, "cannot read 'a=loud' as a log filter", ""),
    (["--log-filter", "a=info"], 2, "cannot select nodes of all dataflows", ""),
    (["{name}", "-b", "-5000"], 4, "cannot find the boot", "--list-boots"),
    (["{name}", "nosuch*"], 4, "no dataflow named 'nosuch*'", ""),
]


@pytest.mark.lab
@pytest.mark.parametrize("scope", ["--system", "--user"])
def test_a_journal_in_memory_that_is_closed(scope: str) -> None:
    """Without /var/log/journal there are no files of users, and the system's is not theirs."""
    script = """
    mount -t tmpfs tmpfs /var/log/journal
    mount -t tmpfs tmpfs /run/log
    install -d -m 0750 /run/log/journal/machine
    touch /run/log/journal/machine/system.journal
    exec setpriv --reuid alice --regid alice --init-groups \\
        env XDG_RUNTIME_DIR=/run/user/1000 doractl "$1" logs robot
    """
    done = run("unshare", "--mount", "sh", "-ec", script, "sh", scope, check=False)
    assert done.returncode == ExitCode.NO_PERMISSION
    assert done.stderr.startswith("doractl: cannot read the ")
    assert "systemd-journal" in done.stderr


class TestWhatIsShown:
    """All of them read the lines of the same dataflow."""

    def test_what_is_shown(self, talks: Cell) -> None:
        left = messages(talks, "--node", "cam-left")
        assert [line for line in left if line.startswith("line")] == [f"line {i}" for i in range(5)]
        both = messages(talks, "--node", "cam-*", "--grep", "^line 3$")
        assert both == ["line 3", "line 3"]
        assert "a bad thing" in messages(talks, "--level", "error")
        assert "on stderr" not in messages(talks, "--level", "warn")
        assert "a detail" in messages(talks, "--level", "debug")
        assert "a tiny detail" not in messages(talks, "--level", "debug")
        assert "a tiny detail" in messages(talks, "--level", "trace")
        assert len(messages(talks, "--tail", "3")) == 3
        assert messages(talks, "--since", "1h")
        assert not messages(talks, "--until", "1 hour ago")
        first, *_, last = messages(talks, "--events")
        assert first == f"Dataflow {talks.name} is starting"
        assert last == f"Dataflow {talks.name} is running, all nodes are ready"
        assert messages(talks, "--events", "--reverse")[-1] == first

    def test_a_full_disk_is_an_error(self, talks: Cell) -> None:
        done = run("sh", "-c", f"doractl logs {talks.name} >/dev/full", check=False)
        assert done.returncode == ExitCode.FAILURE
        assert done.stderr == "doractl: cannot write output: No space left on device\n"

    def test_letters_mean_what_they_mean_in_journalctl(self, talks: Cell) -> None:
        assert len(messages(talks, "-n", "3")) == len(messages(talks, "--lines=3")) == 3
        assert len(messages(talks, "-n", "all")) > 10
        everything = messages(talks, "--events")
        assert messages(talks, "--events", "-b") == messages(talks, "-b0", "--events") == everything
        assert "No entries" in "".join(logs(talks, talks.name, "--until", "1h", check=False))
        assert logs(talks, talks.name, "--until", "1h", "-q", check=False) == []

    def test_found_lines_come_oldest_first(self, talks: Cell) -> None:
        lines = [f"line {i}" for i in range(5)]
        words = ("--node", "cam-left", "--grep", "^line")
        assert messages(talks, *words, "--tail", "3") == lines[-3:]
        assert messages(talks, *words, "--tail", "3", "--reverse") == lines[:1:-1]
        assert len(messages(talks, "--grep", "tick", "--tail", "2")) == 2

    def test_levels_of_single_nodes(self, talks: Cell) -> None:
        words = ("--log-filter", "cam-left=debug, cam-right=error", "--grep", "detail|bad|stderr")
        records = [json.loads(line) for line in logs(talks, talks.name, "-o", "json", *words)]
        told = {(one["DORA_NODE"], one["MESSAGE"]) for one in records}
        left = ("on stderr", "a bad thing", "a detail")
        assert told == {*(("cam-left", text) for text in left), ("cam-right", "a bad thing")}
        started = ("--log-filter", "cam-left=error", "--grep", "all nodes are ready")
        assert len(messages(talks, *started)) == 1
        assert set(messages(talks, "--level", "stdout")) >= {"a tiny detail", "line 0", "on stderr"}

    def test_several_dataflows(self, talks: Cell, class_project: Project) -> None:
        other = Cell(f"{talks.name}-b", talks.scope)
        try:
            other.start(Project(class_project.root / "other").three_nodes())
            sync_journal()
            starting = [f"Dataflow {cell.name} is starting" for cell in (talks, other)]
            for selectors in ((talks.name, other.name), (f"{talks.name}*",)):
                found = logs(talks, *selectors, "-o", "cat", "--events", "--grep", "is starting")
                assert found == starting
            text = shown("doractl", talks.scope.flag, "logs", f"{talks.name}*", "--no-pager")
            assert f"{talks.name}/cam-left" in text
            done = talks.doractl("logs", talks.name, other.name, "--until-end", check=False)
            assert done.stderr.startswith("doractl: cannot wait for the end of several dataflows")
        finally:
            other.end()

    def test_terminal(self, talks: Cell) -> None:
        """Aligned and coloured; the pager is not asked for."""
        command = ["doractl", talks.scope.flag, "logs", talks.name, "--no-pager", "--tail", "40"]
        lines = shown(*command).splitlines()
        assert len(set(re.findall(r"(\x1b\[\d+m)cam", "\n".join(lines)))) == 2
        plain = [re.sub(r"\x1b\[[0-9;:]*m", "", line) for line in lines]
        places = {line.index("tick") for line in plain if line.endswith(" tick")}
        assert len(places) == 1

    def test_pager(self, talks: Cell, tmp_path: Path) -> None:
        seen = tmp_path / "seen"
        words = ("--tail", "5", "--grep", "^line")
        assert shown("doractl", "logs", talks.name, *words, PAGER=f"tee {seen}")
        assert len(seen.read_text().splitlines()) == 5

    def test_bad_input(self, talks: Cell) -> None:
        for arguments, code, problem, hint in BAD_INPUT:
            words = [word.format(name=talks.name) for word in arguments]
            done = talks.doractl("logs", *words, check=False)
            assert (done.returncode, done.stdout) == (code, "")
            first, *rest = done.stderr.splitlines()
            assert first.startswith(f"doractl: {problem}")
            assert len(rest) <= 1
            assert hint in done.stderr

    @pytest.mark.lab
    def test_journal_unreadable(self, talks: Cell) -> None:
        words = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"]
        done = run(*words, "doractl", "--system", "logs", talks.name, check=False)
        assert done.returncode == 8
        assert "cannot read the system's journal" in done.stderr
        assert "systemd-journal" in done.stderr

    def test_no_entries(self, talks: Cell) -> None:
        words = ("logs", talks.name, "--grep", "never said")
        with pytest.raises(AssertionError, match=": 1\n"):
            shown("doractl", talks.scope.flag, *words, PAGER="cat")
        done = talks.doractl(*words, check=False)
        assert "No entries" in done.stdout
        assert not done.stderr
        names = {record["DORA_EVENT"] for record in talks.journal() if "DORA_EVENT" in record}
        assert names
        assert names <= set(EVENTS)

    @pytest.mark.lab
    def test_forged_names_and_nodes_do_not_count(self, talks: Cell) -> None:
        """Anybody can write such records; journald names the unit that has written one."""
        fields = ("MESSAGE=x", f"DORA_DATAFLOW={UUID}", "DORA_NODE=forged")
        own = (f"DORA_DATAFLOW_NAME={talks.name}x", f"SYSLOG_IDENTIFIER={talks.name}/forged")
        send = "import sys; from dora_systemd.adapters.journal.note import send_note as send; "
        send += "send('\\n'.join([*sys.argv[1:], '']).encode())"
        run("runuser", "-u", "alice", "--", sys.executable, "-c", send, *fields, *own)
        wait_for("it", lambda: journalctl("-o", "cat", f"DORA_DATAFLOW={UUID}"))
        for words in ((f"{talks.name}x*",), (UUID[:8],), (talks.name, "--node", "forg*")):
            done = talks.doractl("logs", *words, check=False)
            assert done.returncode == ExitCode.NOT_FOUND, done.stdout
