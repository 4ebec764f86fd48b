"""What dora does with the output of nodes, it does here too: other nodes receive it."""

from pathlib import Path

from tests.system.cells import Cell, Project, run

SPEAKER = """
import json, time
from dora import Node
node = Node()
for event in node:
    if event["type"] == "INPUT":
        line = {"level": "INFO", "message": "words", "timestamp": "2026-01-01T00:00:00Z"}
        print(json.dumps(line), flush=True)
        print("raw words", flush=True)
        break
    if event["type"] == "STOP":
        break
time.sleep(1)
"""
LISTENER = """
from dora import Node
node, heard = Node(), []
for event in node:
    if event["type"] == "INPUT":
        heard += [str(text) for text in event["value"].to_pylist()]
        if any("raw words" in text for text in heard):
            break
print("HEARD", any("raw words" in text for text in heard), flush=True)
"""
OPERATOR = """
from dora import DoraStatus
class Operator:
    # It speaks ten times: what a node says first, dora may drop while a listener connects.
    said = 0
    def on_event(self, event, send_output):
        if event["type"] == "INPUT":
            print("raw words", flush=True)
            self.said += 1
        return DoraStatus.STOP if self.said == 10 else DoraStatus.CONTINUE
"""
TICK = "inputs: {tick: dora/timer/millis/200}"


def heard(flow: Path, cell: Cell) -> list[tuple[int, bool]]:
    """Exit status, and whether the listener heard the speaker: as dora runs it, and as we do."""
    bare = run("dora", "run", str(flow), cwd=flow.parent, check=False)
    ours = run("doractl", "run", str(flow), "--name", cell.name, check=False)
    print(bare, ours)
    return [(done.returncode, "HEARD True" in done.stdout) for done in (bare, ours)]


def test_logs_as_an_input(cell: Cell, project: Project) -> None:
    project.write("speaker.py", SPEAKER)
    project.write("listener.py", LISTENER)
    flow = project.write(
        "dataflow.yml",
        f"""nodes:
  - {{id: speaker, path: speaker.py, {TICK}}}
  - {{id: listener, path: listener.py, inputs: {{logs: dora/logs}}}}
""",
    )
    assert heard(flow, cell) == [(0, True)] * 2


def test_output_of_an_operator_as_an_output(cell: Cell, project: Project) -> None:
    project.write("speaks.py", OPERATOR)
    project.write("listener.py", LISTENER)
    flow = project.write(
        "dataflow.yml",
        f"""nodes:
  - id: speaker
    operator: {{python: speaks.py, {TICK}, outputs: [words], send_stdout_as: words}}
  - {{id: listener, path: listener.py, inputs: {{words: speaker/words}}}}
""",
    )
    assert heard(flow, cell) == [(0, True)] * 2


def test_the_lowest_level_of_lines(cell: Cell, project: Project) -> None:
    project.write("speaker.py", SPEAKER)
    flow = project.write(
        "dataflow.yml",
        f"nodes:\n  - {{id: speaker, path: speaker.py, min_log_level: error, {TICK}}}\n",
    )
    for command in (("dora", "run", str(flow)), ("doractl", "run", str(flow), "--name", cell.name)):
        done = run(*command, cwd=project.root)
        assert "words" not in done.stdout, command
