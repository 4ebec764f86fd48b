"""Every line of every node is in the journal: once, in order, whatever happens meanwhile.

DORA_LOG_LINES says how many lines the floods have: 1000000 for the full measure.
"""

import os
import re
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dora_systemd.decisions.logs.journal_events import EVENTS
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, journalctl, run, wait_for
from tests.system.terminal import shown

LINES = int(os.environ.get("DORA_LOG_LINES", "30000"))
OURS = re.compile(r"\d{8} flood$|last \d{8}$|half a line$")
# How zenoh's warnings begin when a node has gone before another one has found it.
LOST = (
    *("is lost", "failed", "Failed", "exited", "connection error", "disconnected", "killed"),
    "Could not connect",  # the daemon tries again until it is ended
)

# Writes whole lines, at most PIPE_BUF bytes at once: zenoh prints to the same pipe, in the middle
# of a line of Python's buffered stdout it would spoil that line before we see it.
FLOOD = f"""
import os
from dora import Node
node = Node()
for first in range(0, {LINES}, 250):
    lines = ("%08d flood\\n" % i for i in range(first, min(first + 250, {LINES})))
    os.write(1, "".join(lines).encode())
"""
# Floods until it is stopped, and tells then what its last line was.
ENDLESS = """
import os, threading
from dora import Node
node, stop = Node(), threading.Event()
def flood():
    number = 0
    while not stop.is_set():
        os.write(1, "".join("%08d flood\\n" % i for i in range(number, number + 250)).encode())
        number += 250
    os.write(1, b"last %08d\\n" % (number - 1))
thread = threading.Thread(target=flood)
thread.start()
for event in node:
    if event["type"] == "STOP":
        break
stop.set()
thread.join()
"""


def printed(cell: Cell, node: str, *matches: str) -> list[str]:
    """What a node printed, quickly: there may be a million lines."""
    where = (f"_SYSTEMD_UNIT={cell.unit}", f"DORA_NODE={node}", "DORA_STREAM=stdout")
    lines = journalctl("-o", "cat", *where, *matches).splitlines()
    return [line for line in lines if OURS.match(line)]


def numbered(count: int) -> list[str]:
    return [f"{number:08d} flood" for number in range(count)]


def flow(project: Project, code: str, *nodes: str) -> Path:
    project.write("flood.py", code)
    ids = "\n".join(f"  - {{id: {node}, path: flood.py}}" for node in nodes)
    return project.write("dataflow.yml", f"nodes:\n{ids}\n")


def wait_end(cell: Cell) -> None:
    wait_for("the dataflow ends", lambda: cell.is_gone, 60 + LINES / 5000)


@pytest.mark.lab
@pytest.mark.parametrize("count", [1, 8])
def test_flood(cell: Cell, project: Project, count: int) -> None:
    nodes = [f"n{number}" for number in range(count)]
    cell.start(flow(project, FLOOD.replace(str(LINES), str(LINES // count)), *nodes))
    wait_end(cell)
    for node in nodes:
        assert printed(cell, node) == numbered(LINES // count)


@pytest.mark.lab
def test_restart_keeps_the_last_line(cell: Cell, project: Project) -> None:
    cell.start(flow(project, ENDLESS, "n"), "--grace-duration", "20s")
    for _ in range(2):
        wait_for("a flood", lambda: len(printed(cell, "n")) > 2000)
        cell.systemctl("restart")
    cell.systemctl("stop")
    runs = {record["DORA_RUN"] for record in cell.journal("DORA_EVENT=node-ready")}
    assert len(runs) == 3
    for one in runs:
        *lines, last = printed(cell, "n", f"DORA_RUN={one}")
        assert lines == numbered(len(lines))
        assert last == f"last {len(lines) - 1:08d}"


@pytest.mark.lab
@pytest.mark.warns("Journal", "systemd-journald")
def test_journald_restarted_in_the_middle(cell: Cell, project: Project) -> None:
    cell.start(flow(project, FLOOD, "n"))
    run("systemctl", "restart", "systemd-journald.service")
    wait_end(cell)
    assert printed(cell, "n") == numbered(LINES)


@pytest.mark.lab
@pytest.mark.warns(*LOST)
def test_coordinator_killed_in_the_middle(cell: Cell, project: Project) -> None:
    cell.start(flow(project, ENDLESS, "n"))
    wait_for("a flood", lambda: len(printed(cell, "n")) > 2000)
    os.kill(cell.supervisor_pid("coordinator"), signal.SIGKILL)
    wait_end(cell)
    lines = [line for line in printed(cell, "n") if line.endswith(" flood")]
    assert lines == numbered(len(lines))
    assert cell.events()[-1] == ("dataflow-failed", "")


@pytest.mark.warns("crashed", "exited", "Traceback", "failed", "Failed")
def test_last_words_come_before_the_crash(cell: Cell, project: Project) -> None:
    code = (
        "import sys, time\nfrom dora import Node\nnode = Node()\n"
        "for event in node:\n"
        "    print('half a line', end='', flush=True)\n"
        "    raise ValueError('the last words')\n"
    )
    project.write("bad.py", code)
    flow = "nodes: [{id: bad, path: bad.py, inputs: {tick: dora/timer/millis/100}}]"
    cell.start(project.write("dataflow.yml", flow))
    wait_end(cell)
    records = [record for record in cell.journal() if record.get("DORA_NODE") == "bad"]
    texts = [record["MESSAGE"] for record in records]
    words, crash = (
        texts.index("ValueError: the last words"),
        [record.get("DORA_EVENT") for record in records].index("node-crashed"),
    )
    assert words < crash
    assert texts.index("half a line") < crash
    assert records[texts.index("half a line")]["DORA_CUT"] == "1"
    assert records[crash]["DORA_EXIT"] == "exit code 1"
    assert records[crash]["DORA_RUN"] == records[words]["DORA_RUN"]


ODD = r"""
import sys
from dora import Node
node = Node()
node.log("warn", "hello\nsecond", target="my.target", fields={"shot no": "7"})
out = sys.stdout.buffer
out.write(b"binary \x00\xff\x1b[31m\n" + b"x" * (1 << 20) + b"\n" + b"y" * (3 << 20) + b"\n")
out.write("ünïcode\r\n".encode() + b"\n")
out.flush()
sys.stderr.buffer.write(b"\r 1%|#\r 2%|##\rcaf\xe9 \n")
print("on stderr", file=sys.stderr, flush=True)
"""


@pytest.mark.warns("hello")
def test_odd_lines(cell: Cell, project: Project) -> None:
    cell.start(flow(project, ODD, "odd"))
    wait_end(cell)
    records = [r for r in cell.journal("DORA_NODE=odd") if "DORA_STREAM" in r]
    log, binary, big, *pieces, text, empty = [r for r in records if r["DORA_STREAM"] == "stdout"]
    assert (log["MESSAGE"], log["PRIORITY"], log["DORA_LEVEL"]) == ("hello\nsecond", "4", "warn")
    assert (log["DORA_TARGET"], log["DORA_FIELD_SHOT_NO"]) == ("my.target", "7")
    assert bytes(binary["MESSAGE"]) == b"binary \x00\xff\x1b[31m"
    assert big["MESSAGE"] == "x" * (1 << 20)
    assert "DORA_CUT" not in big
    assert [len(piece["MESSAGE"]) for piece in pieces] == [1 << 20] * 3
    assert [piece.get("DORA_CUT") for piece in pieces] == ["1", "1", None]
    assert (text["MESSAGE"], text["PRIORITY"]) == ("ünïcode", "6")
    assert empty["MESSAGE"] == ""
    *steps, stderr = [r for r in records if r["DORA_STREAM"] == "stderr"]
    assert [step["MESSAGE"] for step in steps] == [" 1%|#", " 2%|##", [*b"caf\xe9 "]]
    assert (stderr["MESSAGE"], stderr["PRIORITY"]) == ("on stderr", "5")
    assert stderr["SYSLOG_IDENTIFIER"] == f"{cell.name}/odd"
    assert int(stderr["DORA_NODE_PID"]) > 1
    words = ("doractl", cell.scope.flag, "logs", cell.name, "--no-pager")
    assert r"caf\xe9 " in shown(*words)
    done = run(*words)
    assert "B blob data]" in done.stdout
    note = "doractl: some messages have control characters; --all prints them, too\n"
    assert done.stderr == note


@pytest.mark.lab
def test_catalog() -> None:
    """systemd reads our explanations, and journalctl -x shows them."""
    source = Path(__file__).parents[2] / "units/templates/dora-systemd.catalog"
    target = Path("/usr/lib/systemd/catalog/dora-systemd.catalog")
    was_there = target.exists()
    target.write_bytes(source.read_bytes())
    try:
        done = run("journalctl", "--update-catalog")
        assert not done.stderr
        listed = run("journalctl", "--list-catalog").stdout
        assert all(f"{kind.message_id} dora-systemd: " in listed for kind in EVENTS.values())
    finally:
        if not was_there:
            target.unlink()
        run("journalctl", "--update-catalog")


LATE = """
import os, time
from dora import Node
node = Node()
while not os.path.exists("/run/logs-late"):
    time.sleep(0.01)
for number in range(1000):
    print("%08d flood" % number, flush=True)
print("half a line", end="", flush=True)
open("/run/logs-late-done/done", "w").close()
time.sleep(100)
"""


@pytest.mark.warns(*LOST)
@pytest.mark.lab
def test_runner_killed_with_lines_in_the_pipes(cell: Cell, project: Project) -> None:
    go, done = Path("/run/logs-late"), Path("/run/logs-late-done")
    done.mkdir(exist_ok=True)
    done.chmod(0o777)
    cell.start(flow(project, LATE, "n"))
    runner = cell.supervisor_pid("runner")
    os.kill(runner, signal.SIGSTOP)
    try:
        go.touch()
        wait_for("the node has written", lambda: (done / "done").exists())
    finally:
        go.unlink()
        os.kill(runner, signal.SIGKILL)
    wait_end(cell)
    assert printed(cell, "n") == [*numbered(1000), "half a line"]
    assert cell.events()[-1] == ("dataflow-failed", "")
    assert any("SIGKILL" in record.get("DORA_REASON", "") for record in cell.journal())
    (done / "done").unlink()


@pytest.mark.lab
@pytest.mark.warns(*LOST)
def test_runner_killed_in_a_flood(cell: Cell, project: Project) -> None:
    """What it had read and not written is not lost either."""
    project.write("flood.py", ENDLESS)
    by_dora = "{id: n2, path: flood.py, send_stdout_as: text, outputs: [text]}"
    cell.start(project.write("dataflow.yml", f"nodes: [{{id: n1, path: flood.py}}, {by_dora}]"))
    for node in ("n1", "n2"):
        wait_for("a flood", lambda node=node: len(printed(cell, node)) > 2000)  # type: ignore[misc]
    os.kill(cell.supervisor_pid("runner"), signal.SIGKILL)
    wait_end(cell)
    # The kill may fall between a line and the note that it was written, of a pipe or of a file.
    for node, most in (("n1", 20), ("n2", 1000)):
        lines = [line for line in printed(cell, node) if line.endswith(" flood")]
        assert sorted(set(lines)) == numbered(int(lines[-1].split()[0]) + 1)
        assert len(lines) - len(set(lines)) <= most


def suppressed(cell: Cell, node: str) -> int:
    """How many lines of a node its limit took, as the events tell."""
    matches = ("DORA_EVENT=lines-suppressed", f"DORA_NODE={node}")
    return sum(int(record["DORA_COUNT"]) for record in cell.journal(*matches))


@pytest.mark.lab
@pytest.mark.warns("exceed its limit")
def test_limits_of_nodes(cell: Cell, project: Project) -> None:
    """What a limit takes is counted to the line, whichever way the lines come."""
    project.write("flood.py", FLOOD)
    by_dora = "{id: by-dora, path: flood.py, send_stdout_as: text, outputs: [text]}"
    nodes = f"[{{id: few, path: flood.py}}, {{id: all, path: flood.py}}, {by_dora}]"
    flow = project.write("dataflow.yml", f"nodes: {nodes}")
    limits = "nodes: {few: {log_rate_limit: 500/1s}, all: {log_rate_limit: infinity}}"
    project.write("dataflow.systemd.yml", limits)
    cell.start(flow, "--log-rate-limit", "1/1h", "--node", "by-dora:log_rate_limit=700/200ms")
    wait_end(cell)
    assert printed(cell, "all") == numbered(LINES)
    for node, least in (("few", 500), ("by-dora", 700)):
        lines = printed(cell, node)
        assert lines[:least] == numbered(least)
        assert lines == sorted(set(lines))
        assert suppressed(cell, node) == LINES - len(lines) > 0
        kinds = [r.get("DORA_EVENT", "line") for r in cell.journal(f"DORA_NODE={node}")]
        assert kinds.index("node-exited") == len(kinds) - 1


@pytest.mark.lab
def test_flood_of_a_node_whose_output_dora_reads(cell: Cell, project: Project) -> None:
    project.write("flood.py", FLOOD)
    node = "{id: n, path: flood.py, send_stdout_as: text, outputs: [text]}"
    cell.start(project.write("dataflow.yml", f"nodes: [{node}]"))
    wait_end(cell)
    assert printed(cell, "n") == numbered(LINES)


# Floods as ENDLESS does, as soon as there is a file "go" beside it.
WHEN_TOLD = ENDLESS.replace(
    "    number = 0\n", "    number = 0\n    while not os.path.exists('go'): stop.wait(0.01)\n"
).replace("stop.set()\n", "stop.set()\nopen('/run/logs-held/stopped', 'w').close()\n")


@contextmanager
def without_journald() -> Iterator[None]:
    """It takes nothing: what it is sent waits, and soon all who send."""
    show = ("systemctl", "show", "--value", "--property", "MainPID", "systemd-journald.service")
    pid = int(run(*show).stdout)
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def is_frozen(group: Path) -> bool:
    return "frozen 1" in (group / "cgroup.events").read_text().splitlines()


@pytest.fixture
def held(project: Project) -> Iterator[Path]:
    """A dataflow whose node n floods when it is told, and writes when it is told to stop."""
    place = Path("/run/logs-held")
    place.mkdir()
    place.chmod(0o777)
    project.write("flood.py", WHEN_TOLD)
    # Without an input dora would not start it again.
    keys = "inputs: {tick: dora/timer/secs/1}, send_stdout_as: text, outputs: [text]"
    keys += ", restart_policy: on-failure"
    yield project.write("dataflow.yml", f"nodes: [{{id: n, path: flood.py, {keys}}}]")
    (place / "stopped").unlink(missing_ok=True)
    place.rmdir()


@contextmanager
def waiting(cell: Cell, project: Project, flow: Path, *options: str) -> Iterator[Path]:
    """The group of n, which floods and is held: journald takes nothing."""
    cell.start(flow, *options)
    group = cell.group / "node-n"
    with without_journald():
        project.write("go", "")
        wait_for("the node is held", lambda: is_frozen(group))
        yield group


def assert_whole(cell: Cell) -> None:
    *lines, last = printed(cell, "n")
    assert lines == numbered(len(lines))
    assert last == f"last {len(lines) - 1:08d}"


@pytest.mark.lab
def test_node_whose_output_dora_reads_waits_for_the_journal(
    cell: Cell, project: Project, held: Path
) -> None:
    with waiting(cell, project, held):
        assert "Running" in cell.doractl("list").stdout
    wait_for("a flood that goes on", lambda: len(printed(cell, "n")) > 60_000, 60)
    cell.systemctl("stop")
    assert_whole(cell)


@pytest.mark.lab
def test_stop_while_a_node_waits_for_the_journal(cell: Cell, project: Project, held: Path) -> None:
    with waiting(cell, project, held):
        begun = time.monotonic()
        cell.systemctl("stop", "--no-block")
        stopped = Path("/run/logs-held/stopped")
        wait_for("the node hears of it", stopped.exists, 5)
    wait_end(cell)
    assert time.monotonic() - begun < bound(10)  # dora would have killed it after 15 s
    assert cell.show("Result") == "success"
    assert_whole(cell)


@pytest.mark.lab
@pytest.mark.warns("are lost", *LOST)
def test_a_stop_ends_in_time_though_journald_hangs(cell: Cell, project: Project) -> None:
    """It receives nothing; after TimeoutStopSec=, 11.5 s, systemd would kill: a timeout."""
    project.write("flood.py", ENDLESS)
    flow = project.write("dataflow.yml", "nodes: [{id: n, path: flood.py}]")
    cell.start(flow, "--grace-duration", "1s")
    with without_journald():
        cell.systemctl("stop")
        assert (cell.show("ActiveState"), cell.show("Result")) == ("inactive", "success")


@pytest.mark.lab
@pytest.mark.warns("exited", "failed to receive reply", *LOST)
def test_reload_while_a_node_waits_for_the_journal(
    cell: Cell, project: Project, held: Path
) -> None:
    with waiting(cell, project, held, "--hot-reload") as group:
        project.write("flood.py", WHEN_TOLD + "# changed\n")
        wait_for("the old one ends", Path("/run/logs-held/stopped").exists, 5)
        wait_for("the new one is held", lambda: is_frozen(group))
    wait_for("it is told", lambda: cell.journal("DORA_EVENT=node-reloaded"))
    cell.systemctl("stop")
    lines = printed(cell, "n")
    again = lines.index(numbered(1)[0], 1)
    # dora may have started the old one once more before it got the new one.
    assert lines[:again] == [*numbered(again - 1), f"last {again - 2:08d}"]
    assert lines[-1].startswith("last")


@pytest.mark.lab
@pytest.mark.warns("crashed", "exited", "restarted", *LOST)
def test_node_that_dies_while_it_waits_for_the_journal(
    cell: Cell, project: Project, held: Path
) -> None:
    with waiting(cell, project, held) as group:
        os.kill(cell.status.nodes["n"].pid, signal.SIGKILL)
        wait_for("it is gone", lambda: not (group / "cgroup.procs").read_text())
    wait_for("it starts again", lambda: len(cell.journal("DORA_EVENT=node-ready")) == 2)
    count = len(printed(cell, "n"))
    wait_for("a flood that goes on", lambda: len(printed(cell, "n")) > count)
    cell.systemctl("stop")
    lines = printed(cell, "n")
    again = lines.index(numbered(1)[0], 1)
    assert lines[:again] == numbered(again)
    assert lines[again:-1] == numbered(len(lines) - again - 1)


@pytest.mark.lab
@pytest.mark.warns(*LOST)
def test_runner_killed_while_a_node_waits_for_the_journal(
    cell: Cell, project: Project, held: Path
) -> None:
    with waiting(cell, project, held):
        os.kill(cell.supervisor_pid("runner"), signal.SIGKILL)
    begun = time.monotonic()
    wait_end(cell)
    assert time.monotonic() - begun < bound(10)
    lines = list(dict.fromkeys(printed(cell, "n")))
    assert lines == numbered(len(lines))
    assert len(lines) > 5_000
