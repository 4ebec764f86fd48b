"""What Prometheus gets from a real gateway of real dataflows."""

import re
import time

import pytest

from tests.system.cells import Cell, Project, wait_for
from tests.system.gateways import Front

# Opens the port of the system.
pytestmark = [pytest.mark.lab, pytest.mark.usefixtures("gateway_up")]

LINE = re.compile(r'(\w+)\{((?:\w+="[^"]*",?)*)\} (\S+)')


def scrape(front: Front) -> dict[tuple[str, ...], float]:
    """All samples: by name and the values of the labels."""
    status, text = front.get("/metrics")
    assert status == 200, text
    found = [LINE.fullmatch(line) for line in text.splitlines() if not line.startswith("#")]
    assert found
    return {(one[1], *re.findall(r'="([^"]*)"', one[2])): float(one[3]) for one in found if one}


def test_a_dataflow(front: Front, cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    first = scrape(front)
    name = cell.name
    assert first["dora_dataflow_state", name, "running"] == 1
    assert first["dora_dataflow_nodes_alive", name] == 3
    assert abs(first["dora_dataflow_ready_time_seconds", name] - time.time()) < 60
    assert first["dora_node_state", name, "source", "running"] == 1
    assert first["dora_node_memory_bytes", name, "sink"] > 1 << 20

    def is_counting() -> bool:
        key = ("dora_node_cpu_seconds_total", name, "source")
        return scrape(front)[key] > first[key]

    wait_for("CPU time is counted", is_counting)
    lines = ("dora_node_log_lines_total", name, "source")
    wait_for("lines are counted", lambda: scrape(front).get(lines, 0) > 0)
    assert scrape(front)["dora_dataflow_log_lines_lost_total", name] == 0


def test_nothing_runs(front: Front) -> None:
    assert [key[0] for key in scrape(front)] == ["dora_systemd_build_info"]
