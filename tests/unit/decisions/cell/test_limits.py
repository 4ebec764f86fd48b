"""Limits: texts and values, control files, and what is refused."""

from typing import Any

import pytest
from hypothesis import given

from dora_systemd.decisions.cell.limits import (
    LIMITS,
    NodeLimits,
    check_nodes,
    format_node_limits,
    limits_of,
    merge_node_limits,
    node_limits,
    parse_node_limits,
)
from dora_systemd.decisions.properties.assignments import format_property, parse_property
from dora_systemd.decisions.settings.limit_checks import (
    Machine,
    check_controllers,
    needed_controllers,
    size_warnings,
)
from dora_systemd.decisions.settings.limits import LIMIT_SETTINGS
from dora_systemd.decisions.settings.resolve import Settings, resolve_settings, with_settings
from dora_systemd.decisions.unit.properties import realtime_properties, settings_properties
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import INFINITY
from tests.unit.fakes.dialogue import OPTIONS
from tests.unit.fakes.limit_values import limits_of_a_node

GIB = 1 << 30


def resolved(flags: dict[str, Any], *documents: object) -> Settings:
    names = ("/srv/robot.systemd.yml", "/etc/dora-systemd/config.yml")
    return resolve_settings(flags, {}, list(zip(names, documents, strict=False)))


def unit_lines(**flags: Any) -> list[str]:
    settings = resolved(flags)
    properties = {**realtime_properties(settings), **settings_properties(settings)}
    return [line for slot in properties for line in format_property(slot, properties)]


@pytest.mark.parametrize(
    ("flags", "lines"),
    [
        ({"cpu_limit": "2.0"}, ["CPUQuota=200%"]),
        ({"cpu_limit": "infinity"}, ["CPUQuota="]),
        ({"memory_limit": "4G"}, ["MemoryMax=4G"]),
        ({"memory_high": "512M", "swap_limit": "0"}, ["MemoryHigh=512M", "MemorySwapMax=0"]),
        ({"tasks_limit": "50"}, ["TasksMax=50"]),
        ({"tasks_limit": "infinity"}, ["TasksMax=infinity"]),
        ({"cpu_weight": "200", "io_weight": "50"}, ["CPUWeight=200", "IOWeight=50"]),
        ({"nice": "-5"}, ["Nice=-5"]),
        ({"realtime": "20"}, ["CPUSchedulingPolicy=rr", "CPUSchedulingPriority=20"]),
        ({"realtime": "fifo:1"}, ["CPUSchedulingPolicy=fifo", "CPUSchedulingPriority=1"]),
        (
            {"device": ("/dev/video0", "/dev/by-path/pci-0:1.0:r", "char-usb_device:rw")},
            [
                "DeviceAllow=/dev/video0 rw",
                "DeviceAllow=/dev/by-path/pci-0:1.0 r",
                "DeviceAllow=char-usb_device rw",
            ],
        ),
        ({}, []),
    ],
)
def test_settings_are_properties(flags: dict[str, Any], lines: list[str]) -> None:
    assert unit_lines(**flags) == lines


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        *[("memory_limit", text) for text in ("0", "-1", "4 gigs", "", "4", "1023K", "nan", "1e9")],
        *[("cpu_limit", text) for text in ("0", "-1", "0.001", "two", "", "0%", "1e3")],
        *[("tasks_limit", text) for text in ("0", "-1", "1.5", "many", "4294967296")],
        *[("cpu_weight", text) for text in ("0", "10001", "idle", "-1")],
        *[("nice", text) for text in ("20", "-21", "x", "1.5")],
        *[("realtime", text) for text in ("0", "100", "batch:3", "rr:", "fifo:0", "-1")],
        *[("device", (text,)) for text in ("video0", "", "/etc/passwd", "/dev/a b", "/dev/")],
        *[("swap_limit", text) for text in ("-1", "x")],
    ],
)
def test_bad_limits(flag: str, value: object) -> None:
    if value == "":
        value = " "
    with pytest.raises(DoraSystemdError, match=r"^cannot ") as caught:
        resolved({flag: value})
    assert caught.value.code is ExitCode.USAGE
    assert caught.value.message.endswith(f"(--{flag.replace('_', '-')})")
    assert caught.value.hint


def test_every_limit_is_a_setting_of_nodes_too() -> None:
    settings = {setting.name: setting for setting in LIMIT_SETTINGS}
    for limit in LIMITS:
        setting = settings[limit.key]
        assert setting.per_node
        assert setting.property == ("" if setting.only_nodes else limit.property)


@given(limits_of_a_node())
def test_node_limits_and_back(limits: NodeLimits) -> None:
    assert parse_node_limits(format_node_limits(limits)) == limits


def test_order_of_words_does_not_matter() -> None:
    one = parse_node_limits("a.b:memory=1G,cpu=1.5")
    assert one == parse_node_limits("a.b:cpu=150%,memory=1024M")
    assert format_node_limits(one) == "a.b:cpu=150%,memory=1G"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        *[(text, "NODE:memory") for text in ("", "a", "a:", ":memory=1G", "memory=1G")],
        ("a:mem=1G", "did you mean memory?"),
        ("a:colour=1", "valid values: cpu, memory"),
        ("a:memory=1G,memory=2G", "leave one"),
        ("a:memory", "512M"),
        ("a:memory=0", "1M"),
        ("a:cpu=-1", "cores"),
        ("a:tasks=0", "at least 1"),
        ("a:memory=4 gigs", "512M"),
    ],
)
def test_bad_node_limits(text: str, words: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot ") as caught:
        parse_node_limits(text)
    assert words in caught.value.hint
    assert caught.value.code is ExitCode.USAGE


def test_control_files() -> None:
    text = "a:cpu=1.5,memory=1G,memory-high=512M,swap=0,tasks=9,cpu-weight=50,io-weight=200"
    assert parse_node_limits(text).files() == {
        "cpu.max": "150000 100000",
        "memory.max": str(GIB),
        "memory.high": str(GIB // 2),
        "memory.swap.max": "0",
        "pids.max": "9",
        "cpu.weight": "50",
        "io.weight": "default 200",
    }
    lifted = parse_node_limits("a:cpu=infinity,memory=infinity,tasks=infinity").files()
    assert lifted == {"cpu.max": "max 100000", "memory.max": "max", "pids.max": "max"}


def test_sources_of_node_limits() -> None:
    """Flag over file beside the dataflow over the system's, limit by limit."""
    beside = {"nodes": {"a": {"memory_limit": "1G", "cpu_limit": 2}, "b": {"tasks_limit": 5}}}
    system = {"nodes": {"a": {"cpu_limit": 1}, "c": {"io_weight": 7}}}
    settings = resolved({"node_limit": ("a:memory=2G", "d:cpu=1")}, beside, system)
    assert {format_node_limits(one) for one in limits_of(with_settings(OPTIONS, settings))} == {
        "a:cpu=200%,memory=2G",
        "b:tasks=5",
        "c:io-weight=7",
        "d:cpu=100%",
    }


def test_merging_keeps_what_is_not_named() -> None:
    lower = (node_limits("a", {"memory": GIB, "cpu": 10**6}),)
    higher = (node_limits("a", {"memory": INFINITY}), node_limits("b", {"tasks": 1}))
    assert merge_node_limits(lower, higher) == (
        node_limits("a", {"memory": INFINITY, "cpu": 10**6}),
        higher[1],
    )


def test_nodes_that_are_not_there() -> None:
    limits = [node_limits("detektor", {"cpu": 10**6})]
    check_nodes(limits, ["detektor"], [])
    with pytest.raises(DoraSystemdError, match="'detektor': no such node") as caught:
        check_nodes(limits, ["camera", "detector"], [])
    assert caught.value.hint == "did you mean detector?"
    with pytest.raises(DoraSystemdError) as caught:
        check_nodes(limits, ["x", "y"], [])
    assert caught.value.hint == "nodes: x, y"
    with pytest.raises(DoraSystemdError, match="dynamic"):
        check_nodes(limits, ["detektor"], ["detektor"])


def test_controllers() -> None:
    properties = {
        **parse_property("MemoryMax=1G"),
        **parse_property("TasksMax=infinity"),
        **parse_property("MemoryHigh=infinity"),
        **parse_property("Nice=5"),
    }
    needed = needed_controllers(properties, [parse_node_limits("a:cpu=1,memory=1G")])
    assert needed == {"memory": "MemoryMax=", "cpu": "cpu of the node a"}
    check_controllers(needed, {"memory", "cpu"}, is_user=False)
    for is_user, hint in ((True, "Delegate="), (False, "container")):
        with pytest.raises(DoraSystemdError) as caught:
            check_controllers(needed, {"memory"}, is_user)
        assert "cpu of the node a: systemd has no 'cpu' cgroup controller" in (caught.value.message)
        assert hint in caught.value.hint


def test_more_than_there_is() -> None:
    machine = Machine(memory=8 * GIB, cores=4, tasks=4096)
    fine = {"memory": 8 * GIB, "cpu": 4 * 10**6, "tasks": INFINITY, "swap": 99 * GIB}
    assert size_warnings(fine, [], machine) == ()
    node = parse_node_limits("a:memory=9G,cpu=5")
    assert size_warnings({"memory": 2 * GIB, "cpu": 8 * 10**6, "tasks": None}, [node], machine) == (
        "the limit cpu=8 cores of the dataflow is more than this machine has: 4 cores",
        "the limit memory=9G of the node a is more than this machine has: 8G",
        "the limit cpu=5 cores of the node a is more than this machine has: 4 cores",
        "the limit memory=9G of the node a is more than the dataflow may use: 2G",
    )
