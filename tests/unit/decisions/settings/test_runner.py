"""A setting travels as text: to the runner, to a member, and through `doractl set`."""

import shlex
from typing import Any

import pytest

from dora_systemd.decisions.cell.environment import SET_VARIABLE, with_changes
from dora_systemd.decisions.cell.launch import watchdogs_of
from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.cell.options import (
    MODULES,
    RunnerOptions,
    SettingText,
    format_runner_argv,
    parse_runner_argv,
    parse_setting,
    runner_setting,
)
from dora_systemd.decisions.cell.owes import owes_of, policies_of
from dora_systemd.decisions.cell.rights import NodeRights, rights_of
from dora_systemd.decisions.cell.stops import NodeStop
from dora_systemd.decisions.descriptor.nodes import parse_node
from dora_systemd.decisions.machines.member import Machine, member_of, on_head
from dora_systemd.decisions.machines.part import own_options
from dora_systemd.decisions.remote.hosts import parse_host
from dora_systemd.decisions.settings.resolve import resolve_settings, with_settings
from dora_systemd.decisions.settings.runner import check_settings
from dora_systemd.decisions.settings.table import SETTINGS
from dora_systemd.decisions.watchdog.watchdogs import ALL_NODES, OFF
from dora_systemd.errors import DoraSystemdError
from dora_systemd.values import INFINITY, SECOND

UUID = "550e8400-e29b-41d4-a716-446655440000"
OPTIONS = RunnerOptions("robot", UUID, "/srv/robot.yml", "/srv", "/usr/bin/dora")
FILE = {
    "stop_limit": "200s",
    "nodes": {"camera": {"stop": "60s"}, "arm": {"stop": {"after": ["camera"]}}},
}
NODES = [parse_node({"id": one, "path": f"{one}.py"}, 0, "robot.yml") for one in ("camera", "arm")]


def started(document: object = FILE) -> RunnerOptions:
    """The options of the runner, from its command line."""
    settings = resolve_settings({}, {}, [("/srv/robot.systemd.yml", document)])
    return parse_runner_argv(format_runner_argv(with_settings(OPTIONS, settings)))


@pytest.mark.parametrize("key", MODULES)
def test_each_module_has_the_settings_of_the_table(key: str) -> None:
    assert runner_setting(key) in SETTINGS


def test_a_value_of_a_file_reaches_the_runner() -> None:
    options = started()
    assert [one for one in format_runner_argv(options) if one.startswith("--set=")] == [
        "--set=stop_limit=3min 20s",
        "--set=camera:stop=within=1min",
        "--set=arm:stop=after=camera",
    ]
    assert options.has("stop")
    assert options.of_dataflow("stop_limit") == 200 * SECOND
    assert options.of_node("camera", "stop") == NodeStop("", 60 * SECOND)
    assert options.of_node("sink", "stop") is None
    assert options.by_node("stop").keys() == {"camera", "arm"}


def test_without_a_value_it_has_the_default() -> None:
    options = started({})
    assert options.settings == ()
    assert not options.has("stop")
    assert options.of_dataflow("stop_limit") == 300 * SECOND


@pytest.mark.parametrize("text", ["stop", "camera:stop", "=1", "camera:=1", "a b=1"])
def test_what_is_no_setting(text: str) -> None:
    with pytest.raises(DoraSystemdError, match="is not"):
        parse_setting(text)


@pytest.mark.parametrize("text", ["stp=1s", "camera:stp=1s"])
def test_a_setting_of_another_version(text: str) -> None:
    """`list` then leaves it out, and names the problem."""
    with pytest.raises(DoraSystemdError, match="unknown setting 'stp'"):
        parse_setting(text)


@pytest.mark.parametrize("text", ["stop=soon", "camera:stop=within=soon"])
def test_the_runner_refuses_a_text_that_is_no_value(text: str) -> None:
    options = OPTIONS._replace(settings=(parse_setting(text),))
    with pytest.raises(DoraSystemdError):
        check_settings(options, NODES)


def test_nodes_have_to_exist() -> None:
    with pytest.raises(DoraSystemdError, match="cannot set stop of the node 'camra'") as caught:
        check_settings(started({"nodes": {"camra": {"stop": "1s"}}}), NODES)
    assert caught.value.hint == "did you mean camera?"
    check_settings(started(), NODES)


def test_a_hot_reload_may_remove_a_node_with_settings() -> None:
    """But a limit could be for a node that was renamed."""
    options = started({"nodes": {"arm": {"watch": "*.py", "watchdog": "5s"}}})
    check_settings(options, NODES[:1], is_reload=True)
    with pytest.raises(DoraSystemdError, match="of the node 'arm'"):
        check_settings(options, NODES[:1])
    with pytest.raises(DoraSystemdError, match="cannot set nice of the node 'arm'"):
        check_settings(started({"nodes": {"arm": {"nice": 5}}}), NODES[:1], is_reload=True)


def test_a_concern_refuses_more() -> None:
    with pytest.raises(DoraSystemdError, match="that is a circle"):
        check_settings(started({"nodes": {"arm": {"stop": {"after": ["arm"]}}}}), NODES)


def with_variable(options: RunnerOptions, texts: Any) -> RunnerOptions:
    return with_changes(options, {SET_VARIABLE: shlex.join(texts)})


def test_a_change_takes_the_place_of_the_value() -> None:
    options = with_variable(started(), ["camera:stop=within=5s", "sink:stop=within=1s"])
    assert options.of_node("camera", "stop") == NodeStop("", 5 * SECOND)
    assert options.by_node("stop").keys() == {"camera", "arm", "sink"}
    assert with_changes(started(), {}) == started()


def spread(setting_key: str, text: str) -> tuple[RunnerOptions, list[str], RunnerOptions]:
    """The head's options, the words for the member `gpu` of the node yolo, and its options."""
    texts = (SettingText("", setting_key, text), *_of_nodes(setting_key, text))
    options = OPTIONS._replace(placed=(Placed("yolo", "gpu"),), settings=texts)
    machine = Machine("gpu", parse_host("gpu-box"), "", {}, (), is_own=True)
    member = member_of(machine, options, resolve_settings({}, {}, ()), {})
    words = [one.removeprefix("--set=") for one in member.words if one.startswith("--set=")]
    settings = resolve_settings({"set": tuple(words)}, {}, [("/srv/robot.systemd.yml", FILE)])
    there = with_settings(OPTIONS._replace(placed=options.placed, machine="gpu"), settings)
    return on_head(options), words, own_options(there)


def _of_nodes(key: str, text: str) -> tuple[SettingText, ...]:
    return (SettingText("camera", key, text), SettingText("yolo", key, text))


def test_each_machine_gets_the_settings_of_its_nodes() -> None:
    head, words, there = spread("stop", "within=7s")
    assert words == ["stop=within=7s", "yolo:stop=within=7s"]
    stop = NodeStop("", 7 * SECOND)
    assert head.by_node("stop") == {"camera": stop, "yolo": stop}, "the head has the order"
    assert there.by_node("stop") == {"yolo": stop}


def test_the_head_decides_with_what_its_members_know_too() -> None:
    """Which failure ends the dataflow, and whose memory goes last."""
    head, words, there = spread("essential", "yes")
    assert head.by_node("essential") == {"camera": True, "yolo": True}
    assert words == ["essential=yes", "yolo:essential=yes"]
    assert there.by_node("essential") == {"yolo": True}


def test_who_restarts_nodes_and_who_watches_them() -> None:
    """dora on the head restarts them; each machine has the sockets of its own nodes."""
    head, words, there = spread("restart_policy", "always")
    assert (words, there.by_node("restart_policy")) == ([], {})
    assert policies_of(head).keys() == {"camera", "yolo"}
    head, words, there = spread("notify", "yes")
    assert words == ["notify=yes", "yolo:notify=yes"]
    assert watchdogs_of(head) == {ALL_NODES: INFINITY, "yolo": OFF}
    assert watchdogs_of(there) == {ALL_NODES: INFINITY}


def test_members_watch_no_outputs() -> None:
    head, words, _ = spread("owes", "image:within=2s")
    assert words == []
    assert head.by_node("owes").keys() == {"camera"}


def test_values_of_a_flag_that_names_nodes_are_those_of_the_nodes() -> None:
    given = {
        "nodes": ("camera:nice=5,essential=yes", "arm:scheduling=idle"),
    }
    owes = ({"output": "d", "within": "9s"}, {"output": "image", "within": "2s"})
    beside = {"nice": 3, "nodes": {"camera": {"nice": 9, "owes": [*owes]}}}
    settings = resolve_settings(given, {}, [("/srv/robot.systemd.yml", beside)])
    options = with_settings(OPTIONS, settings)
    assert [one.partition("=")[2] for one in format_runner_argv(options) if "--set" in one] == [
        "camera:nice=5",
        "camera:owes=d:within=9s,first=30s,then=restart",
        "camera:owes=image:within=2s,first=30s,then=restart",
        "camera:essential=yes",
        "arm:scheduling=idle",
    ], "the nice value for all is a property of the unit"
    assert [one.place for one in owes_of(options)] == ["camera/d", "camera/image"]
    assert rights_of(options)[0] == NodeRights("camera", nice=5, essential=True)


def test_core_dumps_of_a_node() -> None:
    options = started({"nodes": {"camera": {"core_dumps": False}}})
    assert options.by_node("core_dumps") == {"camera": False}
    check_settings(options, NODES)
    dynamic = parse_node({"id": "camera", "path": "dynamic"}, 0, "robot.yml")
    reason = "cannot set core_dumps of the node 'camera': something else starts it"
    with pytest.raises(DoraSystemdError, match=reason):
        check_settings(options, [dynamic])
