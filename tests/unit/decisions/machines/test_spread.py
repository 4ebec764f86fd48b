"""Which node runs where, what a member is told, and what cannot run on several machines."""

from collections.abc import Mapping
from typing import Any

import pytest

from dora_systemd.decisions.cell.launch import watchdogs_of
from dora_systemd.decisions.cell.limits import limits_of
from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.cell.options import RunnerOptions, parse_runner_argv
from dora_systemd.decisions.cell.options import format_runner_argv as runner_argv
from dora_systemd.decisions.descriptor.dataflow import Dataflow, parse_dataflow
from dora_systemd.decisions.machines.member import Member
from dora_systemd.decisions.machines.spread import spread
from dora_systemd.decisions.needs.words import needs_of
from dora_systemd.decisions.settings.resolve import resolve_settings, with_settings
from dora_systemd.errors import DoraSystemdError, ExitCode

FILE = "/srv/robot/dataflow.yml"
BESIDE = "/srv/robot/dataflow.systemd.yml"
CONFIG = "/etc/dora-systemd/config.yml"
UUID = "7d1ab6b8-9c14-4f53-8f6c-3a3ea1a2f0a1"


def no_route(address: str, wanted: str) -> str:
    raise AssertionError(address, wanted)


def flow(*nodes: dict[str, Any]) -> Dataflow:
    return parse_dataflow({"nodes": [{"id": "camera", "path": "a.py"}, *nodes]}, FILE)


def on(machine: str, node: str = "yolo", **more: Any) -> dict[str, Any]:
    return {"id": node, "path": "b.py", "deploy": {"machine": machine}, **more}


def spread_out(
    dataflow: Dataflow,
    document: dict[str, Any] | None = None,
    flags: Mapping[str, object] | None = None,
    source: str = BESIDE,
    **of_options: Any,
) -> tuple[RunnerOptions, tuple[Member, ...]]:
    settings = resolve_settings(flags or {}, {}, [(source, document)])
    options = RunnerOptions("robot", UUID, FILE, "/srv/robot", "/usr/bin/dora", **of_options)
    options = with_settings(options, settings)
    return spread(dataflow, options, settings, {}, "robot-1.lan", no_route)


def refusal(*given: Any, **more: Any) -> str:
    with pytest.raises(DoraSystemdError) as caught:
        spread_out(*given, **more)
    assert caught.value.code is ExitCode.BAD_INPUT
    assert caught.value.hint
    return caught.value.message


def words_of(members: tuple[Member, ...]) -> tuple[str, ...]:
    (member,) = members
    return member.words


def test_by_name_by_labels_and_on_the_head() -> None:
    nodes = (
        on("gpu"),
        on("robot-1", "own"),
        on("robot-1.lan", "full"),
        {"id": "arm", "path": "c.py", "deploy": {"labels": {"arm": True}}},
    )
    machines = {"gpu": {"host": "alice@gpu-box:2222"}, "pi": {"labels": {"arm": "true", "x": 1}}}
    options, members = spread_out(flow(*nodes), {"machines": machines})
    assert options.placed == (Placed("yolo", "gpu"), Placed("arm", "pi"))
    assert [(one.machine, one.host.destination, one.host.port) for one in members] == [
        ("gpu", "alice@gpu-box", "2222"),
        ("pi", "pi", ""),
    ]
    assert parse_runner_argv(runner_argv(options)) == options


def test_one_machine() -> None:
    assert spread_out(flow()) == spread_out(flow(), {"machines": {}})
    options, members = spread_out(flow(), {"machines": {"gpu": None}}, source=CONFIG)
    assert (options.placed, members) == ((), ())


def test_what_a_member_is_told() -> None:
    """Of the nodes what is about its own; of the unit what its entry says."""
    document = {
        "machines": {
            "gpu": {
                "directory": "/home/alice/robot",
                "memory_limit": "8G",
                "env": {"B": 2},
                "venv": "venv",
                "sandbox": "none",
            }
        },
        "memory_limit": "1G",
        "sandbox": "strict",
        "nodes": {
            "yolo": {"memory_limit": "4G", "watchdog": "5s"},
            "camera": {"cpu_limit": 1, "needs": "/dev/video0"},
        },
    }
    options, members = spread_out(flow(on("gpu")), document, {"working_directory": "/srv/robot"})
    assert words_of(members) == (
        "member",
        "/home/alice/robot/dataflow.yml",
        "--name=robot",
        f"--uuid={UUID}",
        "--head=robot-1.lan",
        "--placed=yolo=gpu",
        "--set=yolo:memory_limit=4G",
        "--set=yolo:watchdog=5s",
        "--sandbox=none",
        "--working-directory=/home/alice/robot",
        "--env=B=2",
        "--venv=/home/alice/robot/venv",
        "--memory-limit=8G",
    )
    assert [one.node for one in limits_of(options)] == ["camera"]
    assert [one.node for one in needs_of(options)] == ["camera"]
    assert not options.has("watchdog")


def test_a_flag_overrides_the_host_only() -> None:
    document = {"machines": {"gpu": {"host": "gpu-box", "memory_limit": "8G"}}}
    _, members = spread_out(flow(on("gpu")), document, {"machines": ("gpu=10.0.0.7",)})
    assert members[0].host.destination == "10.0.0.7"
    assert "--memory-limit=8G" in members[0].words


def test_a_watchdog_of_all_nodes() -> None:
    flags = {"machines": ("gpu=x",), "watchdog": "5s"}
    options, members = spread_out(flow(on("gpu")), None, flags)
    assert "--set=watchdog=5s" in words_of(members)
    assert watchdogs_of(options) == {"": 5_000_000, "yolo": 0}


@pytest.mark.parametrize(
    ("node", "text"),
    [
        (on("gpux"), "node yolo: its machine 'gpux' is not declared"),
        (on("head"), "node yolo: its machine 'head' is not declared"),
        (on("gpu", git="https://x/y"), "node yolo cannot run on machine gpu: it is built by dora"),
        (on("gpu", build="make"), "node yolo cannot run on machine gpu: it is built by dora"),
        (on("gpu", path="dynamic"), "node yolo cannot run on machine gpu: dora itself starts it"),
        (on("gpu", path_sha256="0"), "node yolo cannot run on machine gpu: dora itself starts it"),
        (
            {"id": "yolo", "path": "b.py", "deploy": {"labels": {"gpu": "no"}}},
            "node yolo: no machine has the labels 'gpu: no'",
        ),
        ({"id": "yolo", "path": "b.py"}, "no node runs on machine gpu"),
    ],
)
def test_placements_that_do_not_work(node: dict[str, Any], text: str) -> None:
    document = {"machines": {"gpu": {"host": "gpu-box"}}}
    assert refusal(flow(node), document).startswith(f"cannot start {FILE}: {text}")


def test_modules_and_equal_hosts() -> None:
    machines = {"machines": {"gpu": {"host": "x"}, "npu": {"host": "x"}}}
    assert "are the same host x" in refusal(flow(on("gpu"), on("npu", "two")), machines)
    module = {"id": "m", "module": "m.yml"}
    assert "a module cannot" in refusal(flow(on("gpu"), module), {"machines": {"gpu": None}})


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        ({"hot_reload": True}, "hot reload"),
        ({"network": "private"}, "the network is private"),
        ({"nodes": ("yolo:owes=out:within=2s",)}, "node yolo is on machine gpu, and owes"),
        (
            {"nodes": ("yolo:needs=/dev/nvidia0",)},
            "node yolo is on machine gpu, and waits for /dev/nv",
        ),
    ],
)
def test_what_works_on_one_machine_only(flags: dict[str, object], text: str) -> None:
    assert text in refusal(flow(on("gpu")), {"machines": {"gpu": None}}, flags)


def test_more_than_ssh_can_carry() -> None:
    env = {f"A{number}": "x" * 1000 for number in range(100)}
    document = {"machines": {"gpu": {"env": env}}}
    assert "too long for machine gpu" in refusal(flow(on("gpu")), document)


def test_run() -> None:
    flags: dict[str, object] = {"machines": ("gpu=x",)}
    assert "doractl run" in refusal(flow(on("gpu")), None, flags, attached=True)


@pytest.mark.parametrize(
    ("entry", "text"),
    [
        ({"hots": "x"}, f"cannot use machines.gpu in {BESIDE}: unknown key 'hots'"),
        ({"host": "-oProxyCommand=x"}, f"host of machines.gpu in {BESIDE}: cannot use"),
        ({"host": ["a"]}, "the value of host is of another type"),
        ({"directory": "robot"}, "directory of machines.gpu"),
        ({"directory": "/a/../b"}, "directory of machines.gpu"),
        ({"link": "carrier-pigeon"}, "link of machines.gpu"),
        ({"memory_limit": "x"}, "memory_limit of machines.gpu"),
        ({"hot_reload": True}, "unknown key 'hot_reload'"),
        ({"nodes": {}}, "unknown key 'nodes'"),
    ],
)
def test_entries_that_do_not_work(entry: dict[str, Any], text: str) -> None:
    assert text in refusal(flow(on("gpu")), {"machines": {"gpu": entry}})


@pytest.mark.parametrize("text", ["gpu", "=x", "gpu=", "head=x", "a/b=x"])
def test_flags_that_do_not_work(text: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        resolve_settings({"machines": (text,)}, {}, [])
    assert caught.value.code is ExitCode.USAGE
    assert caught.value.hint
