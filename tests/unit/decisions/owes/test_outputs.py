"""What nodes owe: read from settings, checked against the descriptor, handed to dora."""

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as some

from dora_systemd.decisions.cell.extra import PROBE, is_extra
from dora_systemd.decisions.cell.launch import LaunchPlan, launch_descriptor
from dora_systemd.decisions.cell.owes import (
    SHORTEST,
    THEN,
    Owed,
    check_owes,
    format_owed,
    owes_of,
    parse_owed,
)
from dora_systemd.decisions.cell.restarts import RestartPolicy
from dora_systemd.decisions.descriptor.dataflow import Dataflow, parse_dataflow
from dora_systemd.decisions.owes.probe import (
    parse_times,
    probe_definition,
    size_of_times,
)
from dora_systemd.decisions.settings.resolve import resolve_settings, with_settings
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import INFINITY, SECOND
from tests.unit.decisions.cell.test_launch import plan
from tests.unit.fakes.manager import options, with_owes

CAMERA = Owed("camera", "image", 2 * SECOND)


def owes(document: object, *flags: str) -> tuple[Owed, ...]:
    found = resolve_settings({"nodes": flags}, {}, [("/srv/robot.systemd.yml", document)])
    return owes_of(with_settings(options(), found))


def test_from_settings() -> None:
    one = {"output": "image", "within": "2s"}
    two = [one, {"output": "depth", "within": "1min", "then": "fail"}]
    assert owes({"nodes": {"camera": {"owes": one}}}) == (CAMERA,)
    # Who allows a minute between two messages allows it for the first one too.
    depth = Owed("camera", "depth", 60 * SECOND, 60 * SECOND, "fail")
    assert owes({"nodes": {"camera": {"owes": two}}}) == (CAMERA, depth)
    assert owes({"nodes": {"camera": {"owes": "image:within=2s"}}}) == (CAMERA,)
    assert owes({}, "camera:owes=op/image:within=2s,first=1s,then=warn") == (
        Owed("camera", "op/image", 2 * SECOND, SECOND, "warn"),
    )
    # A flag replaces what the file has for that node.
    flags = ("camera:owes=image:within=5s", "camera:nice=5,owes=depth:within=1min,then=fail")
    changed = owes({"nodes": {"camera": {"owes": one}}}, *flags)
    assert changed == (CAMERA._replace(within=5 * SECOND), depth)


@pytest.mark.parametrize(
    ("value", "message", "hint"),
    [
        ({"within": "2s"}, "it names no output", "write output: NAME"),
        ({"output": "image"}, "within which time image has to come", "write within: 2s"),
        ({"output": "image", "within": 2}, "within is '2'", "with its unit such as 500ms"),
        ({"output": "image", "within": "-2s"}, "within is '-2s'", "with its unit"),
        ({"output": "image", "within": "100ms"}, "within is '100ms'", "at least 200ms"),
        ({"output": "image", "within": "infinity"}, "within is 'infinity'", "with its unit"),
        ({"output": "image", "within": "2s", "first": "soon"}, "first is 'soon'", "with its unit"),
        ({"output": "image", "within": "2s", "then": "restrat"}, "'restrat'", "mean restart?"),
        ({"output": "image", "withn": "2s"}, "unknown key 'withn'", "did you mean within"),
        ("image", "'image' is none", "write OUTPUT:within=TIME"),
        (":within=2s", "':within=2s' is none", "within is required"),
        ("image:2s", "is none", "write OUTPUT:within=TIME"),
        ("image:first=2s", "within which time image has to come", "write within: 2s"),
    ],
)  # fmt: skip
def test_bad_values_of_a_node(value: object, message: str, hint: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        owes({"nodes": {"camera": {"owes": value}}})
    assert message in caught.value.message
    assert hint in caught.value.hint
    assert caught.value.code == ExitCode.BAD_INPUT


def test_the_dataflow_itself_owes_nothing() -> None:
    with pytest.raises(DoraSystemdError, match="unknown key 'owes'"):
        owes({"owes": {"output": "image", "within": "2s"}})
    with pytest.raises(DoraSystemdError, match="of another type"):
        owes({"nodes": {"camera": {"owes": 5}}})
    with pytest.raises(DoraSystemdError, match=r"\(--node camera:owes\)"):
        owes({}, "camera:owes=image")


TIMES = some.integers(SHORTEST, INFINITY - 1)
NAMES = some.from_regex(r"[a-z_/:.-]{1,9}", fullmatch=True)


@given(NAMES, TIMES, TIMES, some.sampled_from(THEN))
def test_the_command_line_has_it_exactly(output: str, within: int, first: int, then: str) -> None:
    owed = Owed("", output, within, first, then)
    assert parse_owed(format_owed(owed)) == owed


def owing(owed: Owed) -> LaunchPlan:
    made = plan()
    return made._replace(options=with_owes(made.options, owed))


def flow(**keys: Any) -> Dataflow:
    camera = {"id": "camera", "path": "a.py", "outputs": ["image"], **keys}
    return parse_dataflow({"nodes": [camera]}, "robot.yml")


def check(owed: Owed, dataflow: Dataflow, own: RestartPolicy | None = None) -> str:
    try:
        check_owes((owed,), {"camera": own} if own else {}, dataflow.nodes)
    except DoraSystemdError as error:
        assert error.code == ExitCode.BAD_INPUT
        return f"{error.message}; {error.hint}"
    return ""


def test_outputs_are_those_of_the_descriptor() -> None:
    assert check(CAMERA, flow()) == ""
    wrong = check(CAMERA._replace(output="imag"), flow())
    assert "'imag' of the node 'camera': no such output; did you mean image?" in wrong
    assert "; the node has no outputs" in check(CAMERA, flow(outputs=[]))


def test_no_restart_is_promised_that_dora_does_not_give() -> None:
    never = flow(restart_policy="never")
    assert "cannot restart the silent node 'camera'" in check(CAMERA, never)
    assert check(CAMERA._replace(then="warn"), never) == ""
    assert "its restart_policy; write then: warn" in check(CAMERA, flow(), RestartPolicy("no"))
    assert check(CAMERA, never, RestartPolicy("always")) == ""
    dynamic = flow(path="dynamic")
    assert check(CAMERA, dynamic).endswith("dora does not start it; write then: warn or then: fail")


def test_the_name_of_the_probe_is_taken() -> None:
    idents = ("camera", "dora-systemd-probe")
    both = [{"id": one, "path": "a.py", "outputs": ["image"]} for one in idents]
    assert "give that node another id" in check(
        CAMERA, parse_dataflow({"nodes": both}, "robot.yml")
    )


@pytest.mark.parametrize(("then", "policy"), [("restart", "on-failure"), ("warn", None)])
def test_a_silent_node_has_a_policy(then: str, policy: str | None) -> None:
    """Otherwise dora would not start it again; the numbers are those of the dataflow."""
    made = owing(CAMERA._replace(then=then))
    camera = launch_descriptor(flow(), made)["nodes"][0]
    assert camera.get("restart_policy") == policy
    assert camera.get("max_restarts") == (5 if policy else None)


def test_the_probe_is_a_node_of_its_own() -> None:
    inputs = [(3, CAMERA.place)]
    node = probe_definition(7, ["python", "probe.py"], ("/usr/bin/perl", "/l.pl"), inputs)
    assert is_extra(node["id"], PROBE)
    assert node["inputs"] == {"3": {"source": "camera/image", "queue_size": 1}}
    assert node["args"] == "/l.pl dora-systemd-probe / keep python probe.py"


def test_times_of_a_hostile_file() -> None:
    now = 50 * SECOND
    assert parse_times(struct.pack("=3Q", 7, 8, 0), 2, now) == (7, (8, 0))
    assert parse_times(struct.pack("=4Q", 7, 8, 0, 9), 2, now) == (7, (8, 0))
    assert parse_times(struct.pack("=3Q", 2**64 - 1, now * 2, 5), 2, now) == (0, (0, 5))
    for data in (b"", b"x", bytes(size_of_times(2) - 8), bytes(size_of_times(2) + 1)):
        assert parse_times(data, 2, now) == (0, (0, 0))


def test_the_budget_of_a_node_that_only_owes_is_its_own() -> None:
    dataflow = flow(max_restarts=2, restart_window=60.0)
    (node,) = launch_descriptor(dataflow, owing(CAMERA))["nodes"]
    assert (node["restart_policy"], node["max_restarts"]) == ("on-failure", 2)
    assert node["restart_window"] == 60.0
