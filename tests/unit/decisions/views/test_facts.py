"""NODE_FACTS has a row for each fact of a node, and says of it what is so."""

from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.views.facts import (
    NODE_FACTS,
    NodeRow,
    node_row,
    node_samples,
    node_table,
)
from dora_systemd.decisions.views.rows import DATAFLOW_FACTS, DataflowRow

SHOWN_BY_OTHERS = {"waits_percent"}
"""What `top` and the page measure: a row has no field for it."""


def test_every_field_has_one_row() -> None:
    names = [one.field or one.key for one in NODE_FACTS if one.key not in SHOWN_BY_OTHERS]
    assert sorted(names) == sorted(NodeRow._fields)
    assert len({one.key for one in NODE_FACTS}) == len(NODE_FACTS)


def test_every_field_of_a_dataflow_has_one_row() -> None:
    names = {one.field or one.key for one in DATAFLOW_FACTS} - {"release"}
    assert names - SHOWN_BY_OTHERS == {*DataflowRow._fields} - {"nodes", "listed_release", "is_up"}


def test_columns_and_metrics_are_whole() -> None:
    columns = [one.column for one in NODE_FACTS if one.column]
    metrics = [one.metric for one in NODE_FACTS if one.metric]
    assert len(set(columns)) == len(columns)
    assert len(set(metrics)) == len(metrics)
    assert all(bool(one.metric) == bool(one.help) for one in NODE_FACTS)
    assert all(one.column for one in NODE_FACTS if one.cell or one.rank)


def test_what_the_runner_tells() -> None:
    status = NodeStatus("running", 7, 2, 5, silent="no image for 2s", needs="/dev/x", machine="gpu")
    row = node_row("camera", status, {"text": "hot"})
    expected = {"restarts": 2, "since": 5, "silent": "no image for 2s", "needs": "/dev/x"}
    assert {key: getattr(row, key) for key in expected} == expected
    assert (row.node, row.state, row.pid, row.machine, row.text) == (
        *("camera", "running", 7),
        *("gpu", "hot"),
    )
    assert node_row("camera", None, {}) == NodeRow("camera", "unknown")


def test_texts_are_the_last_columns() -> None:
    row = NodeRow("camera", "running", 7, text="hot", machine="gpu", watchdog=5, cpu_limit=50.0)
    titles, (cells,) = node_table([row])
    assert titles[:4] == ["NODE", "MACHINE", "STATE", "PID"]
    assert titles[-3:] == ["EXIT", "WATCHDOG", "STATUS TEXT"]
    assert (len(cells), cells[-1]) == (12, "hot")
    assert len(node_table([NodeRow("camera", "running")])[0]) == 8


def test_processes_of_a_node_with_a_limit_of_them() -> None:
    limited = NodeRow("camera", "running", tasks=9, tasks_limit=50)
    titles, (cells, other) = node_table([limited, NodeRow("sink", "running", tasks=3)])
    column = titles.index("TASKS")
    assert (cells[column], other[column]) == ("9/50", "3")
    assert "TASKS" not in node_table([NodeRow("sink", "running", tasks=3)])[0]
    fact = next(one for one in NODE_FACTS if one.metric == "tasks")
    assert node_samples(fact, limited) == [({}, 9)]
    assert node_samples(fact, NodeRow("away", "running")) == []
