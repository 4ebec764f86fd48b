"""Who gets nothing any more when a node is gone."""

from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.descriptor.wiring import downstream_of, with_downstream

NODES = [
    {"id": "a", "path": "a", "outputs": ["x"], "inputs": {"t": "dora/timer/millis/1"}},
    {"id": "b", "path": "b", "inputs": {"x": {"source": "a/x"}}, "outputs": ["y"]},
    {"id": "c", "path": "c", "inputs": {"y": "b/y", "x": "a/x"}, "outputs": ["z"]},
    {"id": "d", "path": "d", "inputs": {"z": "c/z"}},
]


def test_chain_and_circle() -> None:
    found = downstream_of(parse_dataflow({"nodes": NODES}, "f"))
    assert found == {"a": ("b", "c", "d"), "b": ("c", "d"), "c": ("d",), "d": ()}
    circle = [{**NODES[0], "inputs": {"z": "c/z"}}, *NODES[1:3]]
    assert downstream_of(parse_dataflow({"nodes": circle}, "f"))["b"] == ("c", "a")


def test_only_failures_name_whom_they_starve() -> None:
    fed = {"a": ("b", "c"), "c": ()}
    crash = ("node-crashed", "a", {"exit": "exit code 1"})
    assert with_downstream(crash, fed)[2] == {"exit": "exit code 1", "downstream": "b c"}
    for event, node in (("node-exited", "a"), ("node-crashed", "c"), ("node-oom", "x")):
        assert with_downstream((event, node, {}), fed) == (event, node, {})
