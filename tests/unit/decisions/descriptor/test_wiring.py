"""Who gets nothing any more when a node is gone."""

from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.descriptor.wiring import downstream_of

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
