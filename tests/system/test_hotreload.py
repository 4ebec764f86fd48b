"""Hot reload with real dora and systemd: a save restarts what it touches, and nothing else."""

import shutil
import time
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import DOUBLER, SINK, THREE_NODES, Cell, Project, run, wait_for

HOT = "--hot-reload"
SHARED = "FACTOR = 2\n"
USES_SHARED = DOUBLER.replace("from dora", "import shared\nfrom dora").replace(
    "2 * event", "shared.FACTOR * event"
)
OTHER_SINK = SINK.replace('"got"', '"got it"')
BROKEN = "import nonsense_that_is_not_there\n"
NOT_RELOADED = "was not reloaded"
# Of a node that has a successor already dora's daemon still expects an answer.
OVERLAP = ("failed to receive reply", "Signal(15)", "dropping `")
CRASHES = (NOT_RELOADED, "crashed", "exit code 1", "ExitCode(1)", "exited with code 1")


def pids(cell: Cell) -> dict[str, int]:
    return {node: one.pid for node, one in cell.status.nodes.items()}


def save(path: Path, text: str) -> None:
    """As editors do: a new file in the place of the old one."""
    new = path.with_name(f".{path.name}.swp")
    new.write_text(text)
    new.chmod(0o644)
    new.rename(path)


def reloads(cell: Cell) -> list[dict[str, str]]:
    return [one for one in cell.journal() if one.get("DORA_EVENT") == "node-reloaded"]


def wait_reloads(cell: Cell, count: int, seconds: float = 30.0) -> list[dict[str, str]]:
    return wait_for(
        f"reload {count}", lambda: found if len(found := reloads(cell)) >= count else [], seconds
    )


def failures(cell: Cell) -> list[str]:
    return [m["MESSAGE"] for m in cell.journal() if m.get("DORA_EVENT") == "reload-failed"]


def test_a_save_restarts_one_node_and_no_message_of_others_is_lost(
    cell: Cell, project: Project
) -> None:
    done = cell.start(project.three_nodes(), HOT)
    assert "(hot-reload enabled)" in done.stdout
    assert done.stdout.endswith("  - .env\n")
    assert "Watching for changes...\n  - *.py\n" in done.stdout
    cell.wait_exchanging()
    before = pids(cell)
    save(project.root / "doubler.py", DOUBLER.replace("2 *", "3 *"))
    (record,) = wait_reloads(cell, 1)
    assert record["MESSAGE"].startswith("Node doubler was reloaded: doubler.py, ready after ")
    after = pids(cell)
    assert {node for node in after if after[node] != before[node]} == {"doubler"}
    cell.wait_exchanging()
    sent = [int(line.split()[1]) for line in cell.messages("source") if line.startswith("sent")]
    assert sent == list(range(len(sent)))
    got = [int(line[5:-1]) for line in cell.messages("sink")]
    assert got[0] == 0
    assert got[-1] % 3 == 0
    assert got == sorted(got)
    assert cell.show("NRestarts") == "0"
    assert not any(node.restarts for node in cell.status.nodes.values())
    assert [event for event, _ in cell.events()].count("files-changed") == 1


def test_each_save_counts_also_of_a_node_that_crashed(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes(), HOT)
    for place, text in enumerate((OTHER_SINK, SINK, OTHER_SINK), 1):
        save(project.root / "sink.py", text)
        wait_reloads(cell, place)
    cell.wait_exchanging()
    assert cell.messages("sink")[-1].startswith("got it")


@pytest.mark.warns(*CRASHES)
def test_a_crash_waits_for_the_next_save(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes(), HOT)
    before = pids(cell)
    save(project.root / "sink.py", BROKEN)
    wait_for("it has crashed", lambda: cell.status.stage == "degraded")
    wait_for("it is said", lambda: failures(cell))
    assert "failed: sink (exit code 1)" in cell.show("StatusText")
    assert cell.status.nodes["sink"].restarts == 0
    save(project.root / "sink.py", SINK)
    wait_reloads(cell, 1)
    cell.wait_exchanging()
    assert cell.status.stage == "running"
    assert "not reloaded" not in cell.show("StatusText")
    assert pids(cell)["source"] == before["source"]
    assert pids(cell)["doubler"] == before["doubler"]


@pytest.mark.warns(NOT_RELOADED)
def test_python_that_does_not_compile_changes_nothing(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes(), HOT)
    before = pids(cell)
    save(project.root / "sink.py", SINK + "if oops(:\n")
    (message,) = wait_for("it is said", lambda: failures(cell))
    assert f"cannot use {project.root}/sink.py: line 7: invalid syntax" in message
    assert "sink.py: line 7: invalid syntax" in cell.doractl("list", cell.name).stdout
    assert pids(cell) == before
    cell.wait_exchanging()
    save(project.root / "sink.py", SINK)
    wait_reloads(cell, 1)
    assert "not reloaded" not in cell.show("StatusText")


def test_a_shared_module_restarts_those_that_import_it(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("shared.py", SHARED)
    project.write("doubler.py", USES_SHARED)
    project.write("sink.py", SINK.replace("from dora", "import shared\nfrom dora"))
    project.write("test_it.py", "")
    cell.start(flow, HOT)
    before = pids(cell)
    save(project.root / "test_it.py", "assert True\n")
    save(project.root / "shared.py", SHARED.replace("2", "5"))
    assert {one["DORA_NODE"] for one in wait_reloads(cell, 2)} == {"doubler", "sink"}
    assert pids(cell)["source"] == before["source"]


def test_the_dataflow_file_node_by_node(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("dataflow.systemd.yml", "nodes: {sink: {watch: '*.txt', needs: /dev/null}}")
    cell.start(flow, HOT)
    before = pids(cell)
    save(flow, THREE_NODES.replace("path: sink.py", "path: sink.py\n    env: {COLOR: red}"))
    wait_reloads(cell, 1)
    environ = Path(f"/proc/{pids(cell)['sink']}/environ").read_text().split("\0")
    assert "COLOR=red" in environ

    second = (
        "  - {id: second, path: sink.py, inputs: {n: {source: source/number, queue_size: 1000}}}\n"
    )
    save(flow, THREE_NODES + second)
    wait_for("it is there", lambda: "second" in cell.status.nodes)
    wait_reloads(cell, 3)
    cell.wait_exchanging("second")
    assert cell.pids("node-second")

    save(flow, THREE_NODES)
    wait_for("it is gone", lambda: "second" not in cell.status.nodes)
    wait_for("so is its group", lambda: not (cell.group / "node-second").exists())
    cell.wait_exchanging()
    assert {node: pids(cell)[node] for node in ("source", "doubler")} == {
        node: before[node] for node in ("source", "doubler")
    }
    rewired = THREE_NODES.replace(
        "double: {source: doubler/double", "number: {source: source/number"
    )
    save(flow, rewired)
    wait_for("it is reconnected", lambda: "reconnected" in reloads(cell)[-1]["MESSAGE"])
    cell.wait_exchanging()
    assert {node: pids(cell)[node] for node in ("source", "doubler")} == {
        node: before[node] for node in ("source", "doubler")
    }
    save(flow, THREE_NODES.partition("  - id: sink")[0])
    wait_for("it goes, whatever its settings are", lambda: "sink" not in cell.status.nodes)


def test_what_dora_cannot_change_restarts_the_dataflow_in_its_unit(
    cell: Cell, project: Project
) -> None:
    flow = project.three_nodes()
    cell.start(flow, HOT)
    runner, invocation = cell.show("MainPID"), cell.show("InvocationID")
    save(flow, "env: {COLOR: blue}\n" + THREE_NODES)
    wait_for("it is reloaded", lambda: ("reloaded", "") in cell.events())
    assert cell.show("ActiveState") == "active"
    assert (cell.show("MainPID"), cell.show("InvocationID")) == (runner, invocation)
    assert cell.show("NRestarts") == "0"
    environ = Path(f"/proc/{pids(cell)['sink']}/environ").read_text().split("\0")
    assert "COLOR=blue" in environ
    cell.wait_exchanging()
    assert ("dataflow-stopped", "") not in cell.events()
    assert cell.doractl("stop", cell.name).returncode == 0


@pytest.mark.warns(NOT_RELOADED, "dora refuses")
def test_a_dataflow_that_is_wrong_changes_nothing(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    cell.start(flow, HOT)
    before = pids(cell)
    for place, text in enumerate(
        ("nodes: [", THREE_NODES.replace("doubler/double", "nobody/double"), ""), 1
    ):
        save(flow, text)
        wait_for("it is said", lambda number=place: len(failures(cell)) >= number)  # type: ignore[misc]
    assert pids(cell) == before
    assert cell.show("ActiveState") == "active"
    cell.wait_exchanging()
    assert "not reloaded: " in cell.show("StatusText")


@pytest.mark.warns(*CRASHES, "Signal(", "failed to send log message")
def test_the_version_before_comes_back(cell: Cell, project: Project) -> None:
    """A changed dataflow whose node does not get ready."""
    flow = project.three_nodes()
    project.write("broken.py", BROKEN)
    cell.start(flow, HOT)
    save(flow, THREE_NODES.replace("sink.py", "broken.py"))
    (message,) = wait_for("it is said", lambda: failures(cell))
    assert "node sink: exit code 1; the previous version is running again" in message
    cell.wait_exchanging()
    # The same where all of it has to start again.
    save(flow, "env: {X: '1'}\n" + THREE_NODES.replace("sink.py", "broken.py"))
    wait_for("it is said", lambda: len(failures(cell)) >= 2)
    wait_for("it runs", lambda: cell.status.stage == "running")
    cell.wait_exchanging()
    assert "not reloaded" in cell.show("StatusText")
    assert cell.show("ActiveState") == "active"


@pytest.mark.warns(*OVERLAP)
def test_by_hand(cell: Cell, project: Project) -> None:
    """Without --hot-reload nothing happens by itself; reload takes over what has changed."""
    project.write("other.py", OTHER_SINK)
    cell.start(project.three_nodes())
    before = pids(cell)
    assert cell.doractl("reload", cell.name).stdout == "Nothing has changed\n"
    project.write("sink.py", OTHER_SINK)
    done = cell.doractl("reload", cell.name)
    assert done.stdout.startswith("The node sink was reloaded: sink.py, ready after ")
    # Nobody reads it: its process has ended before the next one starts, as with node restart.
    assert not Path(f"/proc/{before['sink']}").exists()
    assert ("node-exited", "sink") in cell.events()
    assert cell.doractl("reload", cell.name).stdout == "Nothing has changed\n"
    after = pids(cell)
    assert {node for node in after if after[node] != before[node]} == {"sink"}
    done = cell.doractl("reload", cell.name, "--node", "doubler")
    assert "The node doubler was reloaded" in done.stdout
    project.write("sink.py", SINK)
    cell.systemctl("reload")
    assert len(reloads(cell)) == 3
    # A link in its place, which leads to an older file.
    (project.root / "link").symlink_to("other.py")
    (project.root / "link").rename(project.root / "sink.py")
    done = cell.doractl("reload", cell.name)
    assert "The node sink was reloaded: sink.py" in done.stdout
    assert cell.doractl("reload", cell.name).stdout == "Nothing has changed\n"
    # A node that is added with its program.
    project.write("second.py", SINK)
    second = "  - {id: second, path: second.py, inputs: {n: source/number}}\n"
    project.write("dataflow.yml", THREE_NODES + second)
    done = cell.doractl("reload", cell.name)
    assert "The node second was added: dataflow.yml" in done.stdout
    assert cell.doractl("reload", cell.name).stdout == "Nothing has changed\n"
    cell.wait_exchanging()


@pytest.mark.lab
@pytest.mark.warns(*OVERLAP)
def test_systemd_waits_for_a_reload(cell: Cell, project: Project) -> None:
    """TimeoutStartSec= would end the command, and the runner would go on with the reload."""
    cell.start(project.three_nodes())
    # Not by --property: a start on a busy machine takes longer.
    drop_in = Path(f"/run/systemd/system/{cell.unit}.d/short.conf")
    drop_in.parent.mkdir(exist_ok=True)
    drop_in.write_text("[Service]\nTimeoutStartSec=2s\n")
    run("systemctl", "daemon-reload")
    assert cell.show("TimeoutStartUSec") == "2s"
    project.write("sink.py", f"import time\ntime.sleep(4)\n{SINK}")
    cell.systemctl("reload")
    (done,) = reloads(cell)
    assert done["DORA_NODE"] == "sink"
    cell.end()
    shutil.rmtree(drop_in.parent)
    run("systemctl", "daemon-reload")


@pytest.mark.warns(NOT_RELOADED)
def test_by_hand_refused(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    project.write("sink.py", "def f(:\n")
    done = cell.doractl("reload", cell.name, check=False)
    assert done.returncode == ExitCode.BAD_INPUT
    assert done.stderr.startswith(f"doractl: cannot use {project.root}/sink.py: line 1: ")
    done = cell.doractl("reload", cell.name, "--node", "snik", check=False)
    assert done.returncode == ExitCode.NOT_FOUND
    assert "did you mean sink?" in done.stderr
    cell.end()
    done = cell.doractl("reload", cell.name, check=False)
    assert done.returncode != 0
    assert done.stderr.startswith(("doractl: cannot ", "doractl: no dataflow named "))
    assert len(done.stderr.splitlines()) <= 2


@pytest.mark.warns(*OVERLAP)
def test_switched_on_while_it_runs(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    done = cell.doractl("set", cell.name, "--hot-reload", "on")
    assert done.stdout.startswith("Hot reload on: ")
    save(project.root / "sink.py", OTHER_SINK)
    wait_reloads(cell, 1)
    cell.systemctl("restart")
    save(project.root / "sink.py", SINK)
    wait_reloads(cell, 2)
    cell.doractl("set", cell.name, "--hot-reload", "off")
    save(project.root / "sink.py", OTHER_SINK)
    project.write("doubler.py", DOUBLER)
    assert "sink" in cell.doractl("reload", cell.name).stdout
    assert len([e for e, _ in cell.events() if e == "files-changed"]) == 3


# A save that comes while dora is about to start the node of the save before is taken up again.
@pytest.mark.warns("no running node `sink` to replace")
def test_a_thousand_saves_end_in_the_last_version(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes(), HOT)
    began = time.monotonic()
    for number in range(1000):
        save(project.root / "sink.py", f"NUMBER = {number}\n" + SINK.replace('"got"', "NUMBER"))
    took = time.monotonic() - began
    wait_for(
        "the last version", lambda: any(one.startswith("999 ") for one in cell.messages("sink"))
    )
    assert len(reloads(cell)) <= took + 3


def test_directories_come_and_go(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("parts/__init__.py", "")
    project.write("parts/words.py", "WORD = 'one'\n")
    project.write("sink.py", SINK.replace("from dora", "from parts import words\nfrom dora"))
    cell.start(flow, HOT)
    shutil.copytree(project.root / "parts", project.root / "new")
    shutil.rmtree(project.root / "parts")
    (project.root / "new").rename(project.root / "parts")
    project.write("parts/words.py", "WORD = 'two'\n")
    wait_reloads(cell, 1)
    count = len(reloads(cell))
    project.write("parts/words.py", "WORD = 'three'\n")
    wait_reloads(cell, count + 1)
    cell.wait_exchanging()


def test_what_is_not_watched(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write(".gitignore", "generated/\n")
    done = cell.start(
        flow, HOT, "--watch", "*.py,*.nothing", "--ignore", "draft_*", "--uid", "root"
    )
    assert "no file below" in done.stderr
    assert "--watch '*.nothing'" in done.stderr.replace('"', "'")
    for name in (
        "x.log",
        "generated/a.py",
        "draft_1.py",
        "__pycache__/a.py",
        ".git/a.py",
        "a.toml",
    ):
        project.write(name, "x")
    save(project.root / "sink.py", OTHER_SINK)
    wait_reloads(cell, 1)
    assert len([e for e, _ in cell.events() if e == "files-changed"]) == 1


@pytest.mark.parametrize("pattern", ["/etc/*.py", "../*.py"])
def test_patterns_outside_of_the_project(cell: Cell, project: Project, pattern: str) -> None:
    done = cell.start(project.three_nodes(), HOT, "--watch", pattern, check=False)
    assert done.returncode == ExitCode.USAGE
    assert done.stderr.startswith("doractl: cannot watch ")
    assert cell.is_gone


@pytest.mark.warns(*OVERLAP)
def test_start_first_overlaps(cell: Cell, project: Project) -> None:
    project.write("dataflow.systemd.yml", "nodes: {sink: {replace: start-first}}")
    cell.start(project.three_nodes(), HOT)
    old = pids(cell)["sink"]
    save(project.root / "sink.py", OTHER_SINK)
    wait_reloads(cell, 1)
    wait_for("the old one ends", lambda: not Path(f"/proc/{old}").exists())
    cell.wait_exchanging()
    assert cell.messages("sink")[-1].startswith("got it")


@pytest.mark.warns(*CRASHES, "failed", "Failed")
def test_a_first_start_that_fails_is_a_failed_start(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("sink.py", BROKEN)
    done = cell.start(flow, HOT, check=False)
    assert done.returncode == ExitCode.FAILURE
    assert "exit code 1" in done.stderr


@pytest.mark.vm
@pytest.mark.warns(NOT_RELOADED)
def test_a_settings_file(cell: Cell, project: Project) -> None:
    """Limits of nodes hold at once, and over a reload of the whole; the rest is named."""
    flow = project.three_nodes()
    cell.start(flow, HOT)
    before = pids(cell)
    limit, run = cell.group / "node-sink/memory.max", cell.status.run
    settings = project.write("dataflow.systemd.yml", "nodes: {sink: {memory_limit: 1G}}")
    # Files are asked first: reading the journal takes all of a slow processor.
    wait_for("it is limited", lambda: limit.read_text() == f"{1 << 30}\n")
    (record,) = wait_reloads(cell, 1)
    assert record["MESSAGE"] == "Node sink was given new limits: dataflow.systemd.yml"
    save(flow, "env: {COLOR: blue}\n" + THREE_NODES)
    wait_for("it is another run", lambda: cell.status.run not in ("", run))
    wait_for("it runs", lambda: cell.status.stage == "running")
    wait_for("it is reloaded", lambda: ("reloaded", "") in cell.events())
    assert limit.read_text() == f"{1 << 30}\n"
    save(settings, "env: {A: b}\nnodes: {sink: {memory_limit: lots}}")
    wait_for("it is refused", lambda: "not reloaded" in cell.status.text)
    wait_for("it is told", lambda: len(failures(cell)) >= 1)
    save(settings, "env: {A: b}\n")
    wait_for("it is not limited", lambda: limit.read_text() == "max\n")
    wait_for("it is named", lambda: len(failures(cell)) >= 2)
    assert "dataflow.systemd.yml: env: only doractl stop and start" in failures(cell)[-1]
    assert pids(cell).keys() == before.keys()


OPERATOR = """
from dora import DoraStatus
import pyarrow as pa
class Operator:
    def on_event(self, event, send_output):
        if event["type"] == "INPUT":
            send_output("double", pa.array([2 * event["value"][0].as_py()]))
        return DoraStatus.CONTINUE
"""


def test_a_python_operator_reads_its_file_again(cell: Cell, project: Project) -> None:
    """In place: the process stays, dora reloads the module."""
    flow = project.three_nodes()
    project.write("op.py", OPERATOR)
    text = THREE_NODES.replace("path: doubler.py", "operator:\n      python: op.py")
    text = text.replace("    inputs: {number", "      inputs: {number")
    flow.write_text(text.replace("    outputs: [double]", "      outputs: [double]"))
    cell.start(flow, HOT)
    cell.wait_exchanging()
    before = pids(cell)
    save(project.root / "op.py", OPERATOR.replace("2 *", "-1 *"))
    (record,) = wait_reloads(cell, 1)
    assert "was reloaded in place: op.py" in record["MESSAGE"]
    wait_for("the new code", lambda: "got [-" in "".join(cell.messages("sink")[-1:]))
    assert pids(cell) == before
