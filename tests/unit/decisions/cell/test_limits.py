"""Limits: texts and values, control files, and what is refused."""

from typing import Any

import pytest

from dora_systemd.decisions.cell.limits import (
    LIMITS,
    check_nodes,
    limits_of,
    node_limits,
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
from tests.unit.fakes.limit_values import limits_from

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


def test_order_of_words_does_not_matter() -> None:
    one = limits_from("a.b:memory_limit=1G,cpu_limit=1.5")
    assert one == limits_from("a.b:cpu_limit=150%,memory_limit=1024M")
    assert one.limits == (("cpu_limit", 1_500_000), ("memory_limit", GIB))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        *[(text, "NODE:KEY") for text in ("", "a", "a:", ":memory_limit=1G", "memory_limit=1G")],
        ("a:memory_limi=1G", "did you mean memory_limit"),
        ("a:colour=1", "dora-systemd.yml(5) lists the keys"),
        ("a:memory_limit", "write memory_limit=VALUE"),
        ("a:memory_limit=", "512M"),
        ("a:memory_limit=0", "1M"),
        ("a:cpu_limit=-1", "cores"),
        ("a:tasks_limit=0", "at least 1"),
        ("a:memory_limit=4 gigs", "512M"),
        ("a:memory_limit=1G,2", "512M"),
    ],
)
def test_bad_node_limits(text: str, words: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot .*\(--node( a:[a-z_]+)?\)$") as caught:
        resolved({"nodes": (text,)})
    assert words in caught.value.hint
    assert caught.value.code is ExitCode.USAGE


def test_control_files() -> None:
    text = (
        "a:cpu_limit=1.5,memory_limit=1G,memory_high=512M,swap_limit=0,tasks_limit=9,"
        "cpu_weight=50,io_weight=200"
    )
    assert limits_from(text).files() == {
        "cpu.max": "150000 100000",
        "memory.max": str(GIB),
        "memory.high": str(GIB // 2),
        "memory.swap.max": "0",
        "pids.max": "9",
        "cpu.weight": "50",
        "io.weight": "default 200",
    }
    lifted = limits_from("a:cpu_limit=infinity,memory_limit=infinity,tasks_limit=infinity").files()
    assert lifted == {"cpu.max": "max 100000", "memory.max": "max", "pids.max": "max"}


def test_sources_of_node_limits() -> None:
    """Flag over file beside the dataflow over the system's, limit by limit."""
    beside = {"nodes": {"a": {"memory_limit": "1G", "cpu_limit": 2}, "b": {"tasks_limit": 5}}}
    system = {"nodes": {"a": {"cpu_limit": 1}, "c": {"io_weight": 7}}}
    settings = resolved({"nodes": ("a:memory_limit=2G", "d:cpu_limit=1")}, beside, system)
    assert {*limits_of(with_settings(OPTIONS, settings))} == {
        *map(limits_from, ("a:cpu_limit=2,memory_limit=2G", "b:tasks_limit=5")),
        *map(limits_from, ("c:io_weight=7", "d:cpu_limit=1")),
    }


def test_nodes_that_are_not_there() -> None:
    limits = [node_limits("detektor", {"cpu_limit": 10**6})]
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
    needed = needed_controllers(properties, [limits_from("a:cpu_limit=1,memory_limit=1G")])
    assert needed == {"memory": "MemoryMax=", "cpu": "cpu_limit of the node a"}
    check_controllers(needed, {"memory", "cpu"}, is_user=False)
    for is_user, hint in ((True, "Delegate="), (False, "container")):
        with pytest.raises(DoraSystemdError) as caught:
            check_controllers(needed, {"memory"}, is_user)
        assert "cpu_limit of the node a: systemd has no 'cpu' cgroup" in caught.value.message
        assert hint in caught.value.hint


def test_the_controller_that_a_user_lacks_is_delegated_by_the_hint() -> None:
    for controller in ("cpu", "cpuset", "memory", "pids", "io"):
        with pytest.raises(DoraSystemdError) as caught:
            check_controllers({controller: "a limit"}, {"x"}, is_user=True)
        assert controller in caught.value.hint.partition("Delegate=")[2].split()


def test_sizes_that_look_the_same_and_one_core() -> None:
    machine = Machine(memory=2 * GIB - 30 * 1024**2, cores=1, tasks=4096)
    limits = {"memory_limit": 2 * GIB, "cpu_limit": 2 * 10**6}
    assert size_warnings(limits, [], machine) == (
        "the limit memory_limit=2048M of the dataflow is more than this machine has: 2018M",
        "the limit cpu_limit=2 cores of the dataflow is more than this machine has: 1 core",
    )


def test_more_than_there_is() -> None:
    machine = Machine(memory=8 * GIB, cores=4, tasks=4096)
    fine = {"memory_limit": 8 * GIB, "cpu_limit": 4 * 10**6, "tasks_limit": INFINITY}
    fine |= {"swap_limit": 99 * GIB}
    assert size_warnings(fine, [], machine) == ()
    node = limits_from("a:memory_limit=9G,cpu_limit=5")
    limits = {"memory_limit": 2 * GIB, "cpu_limit": 8 * 10**6, "tasks_limit": None}
    assert size_warnings(limits, [node], machine) == (
        "the limit cpu_limit=8 cores of the dataflow is more than this machine has: 4 cores",
        "the limit memory_limit=9G of the node a is more than this machine has: 8G",
        "the limit cpu_limit=5 cores of the node a is more than this machine has: 4 cores",
        "the limit memory_limit=9G of the node a is more than the dataflow may use: 2G",
    )
