"""What starts again when files change."""

from typing import Any

import pytest

from dora_systemd.decisions.reload.changes import (
    Difference,
    How,
    NodeSources,
    Step,
    Touched,
    difference,
    plan_steps,
    touched,
)
from dora_systemd.decisions.reload.watch_rules import WatchRules

NODES = {
    "camera": NodeSources(frozenset({"/p/camera.py", "/p/shared.py"}), "camera.py"),
    "plot": NodeSources(
        frozenset({"/p/plot.py", "/p/shared.py"}),
        "plot.py --config plot.toml",
        WatchRules("/p", ("*.png",)),
    ),
    "binary": NodeSources(frozenset({"/p/bin/detector"}), "bin/detector"),
}


@pytest.mark.parametrize(
    ("changed", "nodes"),
    [
        ("camera.py", "camera"),
        ("shared.py", "camera plot"),
        ("plot.toml", "plot"),
        ("icon.png", "plot"),
        ("bin/detector", "binary"),
        ("test_all.py", ""),
        ("robot.toml", "camera plot binary"),
        ("camera.py plot.toml", "camera plot"),
    ],
)
def test_whom_a_file_concerns(changed: str, nodes: str) -> None:
    paths = [f"/p/{name}" for name in changed.split()]
    assert set(touched(paths, "/p/dataflow.yml", NODES).nodes) == set(nodes.split())


def test_the_first_file_is_the_reason() -> None:
    found = touched(["/p/shared.py", "/p/camera.py"], "/p/dataflow.yml", NODES)
    assert found.nodes == {"camera": "/p/camera.py", "plot": "/p/shared.py"}


def test_the_dataflow_itself() -> None:
    assert touched(["/p/dataflow.yml"], "/p/dataflow.yml", NODES) == Touched({}, True)


A = {"id": "a", "path": "a.py", "outputs": ["x"]}
B = {"id": "b", "path": "b.py", "inputs": {"x": "a/x"}}
C = {"id": "c", "path": "c.py", "inputs": {"x": "a/x"}}


def flow(*nodes: dict[str, Any], **keys: Any) -> dict[str, Any]:
    return {"nodes": list(nodes), **keys}


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (flow(A, B), flow(B, A), Difference()),
        (flow(A, B), flow({**A, "args": "--fast"}, B), Difference(replaced=("a",))),
        (flow(A, B), flow({**A, "env": {"X": "1"}}, B), Difference(replaced=("a",))),
        (flow(A, B), flow(A, B, C), Difference(added=("c",))),
        (flow(A, B, C), flow(A, C), Difference(removed=("b",))),
        (flow(A, B), flow(A, C), Difference(added=("c",), removed=("b",))),
        (
            flow(A, B),
            flow({**A, "outputs": ["x", "y"]}, B),
            Difference(whole="inputs or outputs of the node a have changed"),
        ),
        (flow(A, B), flow(A, {**B, "inputs": {"y": "a/x"}}), Difference(rewired=("b",))),
        (
            flow(A),
            flow(A, env={"X": "1"}),
            Difference(whole="keys of the dataflow itself have changed"),
        ),
        (
            flow(A),
            flow(A, {"id": "o", "operator": {"python": "o.py"}}),
            Difference(whole="the node o is made of operators"),
        ),
    ],
)
def test_differences(old: dict[str, Any], new: dict[str, Any], expected: Difference) -> None:
    assert difference(old, new) == expected
    assert difference(old, new).is_empty == (expected == Difference())


FLOW = "/p/dataflow.yml"
KINDS = {"a": "python", "b": "executable", "c": "operator", "d": "dynamic"}


def test_what_goes_first() -> None:
    change = Difference(replaced=("r",), rewired=("w",), added=("n",), removed=("x",))
    steps = plan_steps(Touched({"a": "/p/a.py"}, True), change, KINDS, FLOW)
    assert [(step.how, step.node) for step in steps] == [
        (How.REMOVE, "x"),
        (How.REWIRE, "w"),
        (How.SWAP, "r"),
        (How.SWAP, "a"),
        (How.ADD, "n"),
    ]
    assert [step.file for step in steps] == [FLOW, FLOW, FLOW, "/p/a.py", FLOW]


def test_each_node_once_and_dynamic_ones_never() -> None:
    found = Touched({node: f"/p/{node}.py" for node in "abcd"}, True)
    steps = plan_steps(found, Difference(replaced=("a",)), KINDS, FLOW)
    assert steps == (
        Step(How.SWAP, "a", FLOW),
        Step(How.SWAP, "b", "/p/b.py"),
        Step(How.OPERATOR, "c", "/p/c.py"),
    )


def test_a_node_that_is_added_with_its_program_is_added_once() -> None:
    found = Touched({"n": "/p/n.py"}, True)
    steps = plan_steps(found, Difference(added=("n",)), {**KINDS, "n": "python"}, FLOW)
    assert steps == (Step(How.ADD, "n", FLOW),)
