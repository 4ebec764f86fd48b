"""What real lives record for `doractl advise`, and what it says of too few of them."""

import json

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, sync_journal, wait_for


def peaks(cell: Cell, event: str) -> list[str]:
    sync_journal()
    return [one.get("DORA_CPU_PEAK", "") for one in cell.journal(f"DORA_EVENT={event}")]


def test_the_ends_of_a_life_say_what_it_has_used(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    first = wait_for("a sample", lambda: cell.status.samples)[-1]
    wait_for("two more", lambda: first not in cell.status.samples)
    cell.doractl("stop", cell.name)
    assert all(one.isdecimal() for one in peaks(cell, "dataflow-stopped"))
    assert [one.isdecimal() for one in peaks(cell, "node-exited")] == [True] * 3
    done = cell.doractl("advise", cell.name)
    assert done.stdout.startswith(f"{cell.name}: too little is recorded: 1 life, ")
    found = json.loads(cell.doractl("advise", cell.name, "--apply", "-o", "json").stdout)
    assert (found["lives"], found["advice"], found["applied"]) == (1, [], False)
    assert found["file"] == str(project.root / "dataflow.systemd.yml")
    assert not (project.root / "dataflow.systemd.yml").exists()
    assert cell.doractl("advise", "nobody", check=False).returncode == ExitCode.NOT_FOUND
