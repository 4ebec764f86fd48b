"""The setting `record`."""

from typing import Any

import pytest

from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.nodes import parse_node
from dora_systemd.decisions.recorder.record import (
    ROOM,
    Record,
    check_memory,
    check_record,
    format_record,
    limit_of,
    parse_record,
    recorded_outputs,
)
from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.errors import DoraSystemdError
from dora_systemd.values import SECOND

MEGABYTE = 1024 * 1024
UUID = "550e8400-e29b-41d4-a716-446655440000"
OPTIONS = RunnerOptions("robot", UUID, "/srv/robot.yml", "/srv", "/usr/bin/dora")
NODES = [
    parse_node({"id": "camera", "path": "a.py", "outputs": ["image", "info"]}, 0, "robot.yml"),
    parse_node({"id": "arm", "path": "b.py", "outputs": ["state"]}, 1, "robot.yml"),
    parse_node({"id": "sink", "path": "c.py"}, 2, "robot.yml"),
]
WHOLE = Record(30 * SECOND, 200 * MEGABYTE, ("camera/image", "arm/state"))


def of_file(value: Any) -> Any:
    settings = resolve_settings({}, {}, [("/srv/robot.systemd.yml", {"record": value})])
    return settings.values["record"]


def test_it_is_written_in_a_file_and_as_text() -> None:
    whole = {"last": "30s", "memory": "200M", "outputs": ["camera/image", "arm/state"]}
    assert of_file(whole) == WHOLE
    text = format_record(WHOLE)
    assert text == "last=30s,memory=200M,outputs=camera/image+arm/state"
    assert parse_record(text) == of_file(text) == WHOLE
    assert of_file({"outputs": "camera/image"}).outputs == ("camera/image",)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        *((True, Record()), ("yes", Record()), (False, None), ("off", None)),
        ({"memory": "1G"}, Record(memory=1024 * MEGABYTE)),
    ],
)
def test_the_defaults(value: Any, expected: Any) -> None:
    found = of_file(value)
    assert found == expected
    assert parse_record(format_record(found)) == expected


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("maybe", "'maybe' is none"),
        ("last=1s,x", "'last=1s,x' is none"),
        ("last=1s,last=2s", "is none"),
        ("lst=1s", "unknown key 'lst'"),
        ("last=10ms", "last is '10ms'"),
        ("last=infinity", "last is 'infinity'"),
        ("memory=100K", "memory is '100K'"),
        ("outputs=camera", "'camera' is no output"),
        ("outputs=camera/image+", "'' is no output"),
    ],
)
def test_what_is_refused_in_one_line(text: str, words: str) -> None:
    with pytest.raises(DoraSystemdError, match=words) as caught:
        parse_record(text)
    assert caught.value.hint
    assert "\n" not in caught.value.message


def refused(options: RunnerOptions, *outputs: str, nodes: Any = NODES) -> str:
    with pytest.raises(DoraSystemdError) as caught:
        check_record(Record(outputs=outputs), options, nodes)
    return f"{caught.value.message}; {caught.value.hint}"


def test_the_outputs_have_to_exist_on_this_machine() -> None:
    check_record(WHOLE, OPTIONS, NODES)
    check_record(None, OPTIONS, NODES)
    assert refused(OPTIONS, "camera/imge") == (
        "cannot record 'camera/imge': no such output; did you mean camera/image or camera/info?"
    )
    assert "outputs: arm/state, camera/image, camera/info" in refused(OPTIONS, "x/y")
    away = OPTIONS._replace(placed=(Placed("camera", "gpu"),))
    assert "it is on machine gpu" in refused(away, "camera/image")
    named = parse_node({"id": "dora-systemd-recorder", "path": "a.py"}, 0, "robot.yml")
    assert "has a name that doractl needs" in refused(OPTIONS, nodes=[named])
    topics = parse_node({"id": "r", "ros2": {}}, 0, "robot.yml")
    check_record(Record(outputs=("r/any",)), OPTIONS, [topics])


def test_what_is_recorded_by_default() -> None:
    assert recorded_outputs(WHOLE, OPTIONS, NODES) == WHOLE.outputs
    everything = ("arm/state", "camera/image", "camera/info")
    assert recorded_outputs(Record(), OPTIONS, NODES) == everything
    away = OPTIONS._replace(placed=(Placed("camera", "gpu"),))
    assert recorded_outputs(Record(), away, NODES) == ("arm/state",)


def test_the_machine_needs_the_memory() -> None:
    record = Record(memory=1024 * MEGABYTE)
    check_memory(record, record.memory + ROOM)
    words = "cannot record in 1G and 160M for the recorder: this machine has 1G"
    with pytest.raises(DoraSystemdError, match=words):
        check_memory(record, 1024 * MEGABYTE)
    assert limit_of(record, 1024 * MEGABYTE) == record.memory + ROOM
    assert limit_of(record, 8192 * MEGABYTE) == 2048 * MEGABYTE, "large messages wait for it"
