"""A dataflow whose source needs a path, and what is seen of it from outside."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.system.cells import Cell, Project, wait_for

FRAGILE = """
import sys, time
from pathlib import Path
from dora import Node
node = Node()
for event in node:
    if event["type"] == "INPUT" and not Path(sys.argv[1]).exists():
        sys.exit("the device is gone")
"""
"""A driver that ends by itself when its device is unplugged."""


def with_needs(project: Project, needs: Sequence[Path | str], node: str = "source") -> Path:
    """Three nodes; `node` needs these paths."""
    words = json.dumps([str(one) for one in needs])
    project.write("dataflow.systemd.yml", f"nodes: {{{node}: {{needs: {words}}}}}\n")
    return project.three_nodes()


def fragile(project: Project, path: Path) -> Path:
    """A driver that ends when `path` is gone, which is essential, and a node beside it."""
    project.write("driver.py", FRAGILE)
    project.write("dataflow.systemd.yml", f"nodes: {{driver: {{needs: {path}, essential: yes}}}}\n")
    project.three_nodes()
    return project.write(
        "dataflow.yml",
        "nodes:\n"
        f"  - {{id: driver, path: driver.py, args: {path}, "
        "inputs: {tick: dora/timer/millis/50}}\n"
        "  - {id: sink, path: sink.py, inputs: {double: dora/timer/millis/50}}\n",
    )


def seen(cell: Cell) -> dict[str, Any]:
    """What `list -o json` says of the dataflow."""
    found: dict[str, Any] = json.loads(cell.doractl("list", cell.name, "-o", "json").stdout)
    return found


def node_of(cell: Cell, node: str) -> dict[str, Any]:
    """What `list -o json` says of a node."""
    return next(one for one in seen(cell)["nodes"] if one["node"] == node)


def wait_waiting(cell: Cell, node: str, path: Path | str) -> dict[str, Any]:
    """Return when the node waits for `path`, and its launcher is the only process of it."""

    def waits() -> dict[str, Any] | None:
        if not cell.status.nodes[node].needs:
            return None
        one = node_of(cell, node)
        is_so = one["state"] == "waiting" and str(path) in (one["waits_for"] or "")
        pids = cell.pids(f"node-{node}")
        return one if is_so and len(pids) == 1 and pids == [one["pid"]] else None

    found = wait_for(f"{node} waits for {path}", waits)
    assert found is not None
    return found


def wait_running(cell: Cell) -> None:
    """Return when all nodes run."""
    wait_for("all nodes run", lambda: seen(cell)["status"] == "Running" and _all_alive(cell))


def _all_alive(cell: Cell) -> bool:
    return all(node.is_alive for node in cell.status.nodes.values())


def place_of(cell: Cell, parent: str = "/run") -> Path:
    """A new directory that every user may see, and that no sandbox hides."""
    place = Path(parent, f"needs-{cell.name}")
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(mode=0o755)
    return place
