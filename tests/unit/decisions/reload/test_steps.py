"""In which order a running dataflow follows its files."""

from dora_systemd.decisions.reload.changes import Difference, Touched
from dora_systemd.decisions.reload.steps import How, Step, plan_steps

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
