"""The unit of a dataflow, whole and part by part."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.environment import unit_environment
from dora_systemd.decisions.cell.options import RunnerOptions, options_from_command
from dora_systemd.decisions.properties.kinds import Property, split_words
from dora_systemd.decisions.settings.kinds import TEXT, Kind, Setting
from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.decisions.settings.table import SETTINGS
from dora_systemd.decisions.unit.properties import UnitContext, format_unit, unit_properties
from dora_systemd.decisions.unit.systemd_versions import MIN_VERSION, transient_commands
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import INFINITY, SECOND, format_size, parse_size
from tests.unit.checkout import CHECKOUT

UUID = "550e8400-e29b-41d4-a716-446655440000"
OPTIONS = RunnerOptions(
    "robot", UUID, "/srv/robot/robot.yml", "/srv/robot", "/usr/bin/dora", venv="/srv/robot/.venv"
)
ENVIRONMENT = unit_environment("/usr/bin:/bin", "/srv/robot/.venv", {"MODEL": "a b"})
SYSTEM = UnitContext("/usr/bin/python3", False, "dora", ENVIRONMENT)
USER = UnitContext("/usr/bin/python3", True, None, ENVIRONMENT)

STOP_POST = CHECKOUT / "dora_systemd/stoppost.sh"
UNIT = f"""\
[Unit]
Description=dora dataflow robot (550e8400-e29b-41d4-a716-446655440000)

[Service]
Slice=dora.slice
Type=notify
NotifyAccess=main
ExecStart=:/usr/bin/python3 -E -P -m dora_systemd.runner --name=robot --uuid={UUID} \
--working-directory=/srv/robot --dora=/usr/bin/dora --grace-duration=10s \
--venv=/srv/robot/.venv /srv/robot/robot.yml
ExecStopPost=-:/bin/sh {STOP_POST} /usr/bin/python3 -E -P -m dora_systemd.runner.stop_post robot \
550e8400-e29b-41d4-a716-446655440000
ExecReload=:/usr/bin/python3 -E -P -m dora_systemd.runner.reload.request
FileDescriptorStoreMax=4096
WorkingDirectory=/
TimeoutStartSec=infinity
WatchdogSec=30s
OOMPolicy=continue
KillMode=mixed
TimeoutStopSec=25s
RestartPreventExitStatus=70 72 75 77 78
RestartForceExitStatus=SIGABRT
Restart=no
Delegate=yes
DelegateSubgroup=supervisor
MemoryAccounting=yes
TasksAccounting=yes
IOAccounting=yes
TasksMax=infinity
LimitMEMLOCK=infinity
RuntimeDirectory=dora-systemd/robot
RuntimeDirectoryMode=0700
Environment=PATH=/srv/robot/.venv/bin:/usr/bin:/bin
Environment=VIRTUAL_ENV=/srv/robot/.venv
Environment="MODEL=a b"
User=dora
StandardOutput=journal
StandardError=journal
SyslogIdentifier=robot
LogExtraFields=DORA_DATAFLOW={UUID}
LogExtraFields=DORA_DATAFLOW_NAME=robot
LogRateLimitIntervalSec=1s
LogRateLimitBurst=500000000
"""


def unit(*properties: str, options: RunnerOptions = OPTIONS, context: UnitContext = SYSTEM) -> Any:
    settings = resolve_settings({"property": properties}, {}, [])
    return unit_properties(options, context, settings)


def with_grace(grace: int) -> RunnerOptions:
    return RunnerOptions("a", UUID, "/a.yml", "/", "/usr/bin/dora", grace=grace)


def test_the_whole_unit() -> None:
    assert format_unit(unit()) == UNIT


def test_a_unit_of_a_user() -> None:
    properties = unit(context=USER)
    assert set(unit()) - set(properties) == {
        *("User", "LogExtraFields", "LogRateLimitIntervalSec", "LogRateLimitBurst")
    }


def test_no_user_but_the_caller_in_user_scope() -> None:
    with pytest.raises(DoraSystemdError, match="user scope") as caught:
        unit(context=UnitContext("/usr/bin/python3", True, "dora"))
    assert caught.value.code == ExitCode.USAGE


def test_debian_12_keeps_the_command_lines() -> None:
    """None of them has a "$", which systemd 252 would lose at a daemon-reload."""
    told = transient_commands(unit().values(), MIN_VERSION)
    commands = [name for name, signature, _ in told if signature == "a(sasb)"]
    assert commands == ["ExecStart", "ExecStopPost", "ExecReload"]


def test_types_on_the_bus() -> None:
    properties = unit()
    assert properties["TimeoutStopSec"] == Property("TimeoutStopUSec", "t", 25 * SECOND)
    assert properties["TasksMax"] == Property("TasksMax", "t", INFINITY)
    assert properties["Delegate"] == Property("Delegate", "b", True)
    assert properties["RuntimeDirectory"] == Property(
        "RuntimeDirectory", "as", ("dora-systemd/robot",)
    )
    name, signature, ((path, argv, flags),) = properties["ExecStart"]
    assert (name, signature, path, flags) == (
        *("ExecStartEx", "a(sasas)", "/usr/bin/python3"),
        ("no-env-expand",),
    )
    assert options_from_command(argv) == OPTIONS


@pytest.mark.parametrize(
    ("grace", "timeout"), [(0, 10 * SECOND), (20 * SECOND, 40 * SECOND), (INFINITY, INFINITY)]
)
def test_the_stop_timeout_follows_the_grace_duration(grace: int, timeout: int) -> None:
    properties = unit(options=with_grace(grace))
    assert properties["TimeoutStopSec"].value == timeout


def test_the_user_has_the_last_word() -> None:
    properties = unit("Restart=on-failure", "TimeoutStopSec=3min", "MemoryMax=50%", "Slice=a.slice")
    assert properties["Restart"].value == "on-failure"
    assert properties["TimeoutStopSec"].value == 180 * SECOND
    assert properties["MemoryMax"].name == "MemoryMaxScale"
    assert properties["Slice"].value == "a.slice"


def test_lists_of_the_user_are_joined_to_ours() -> None:
    properties = unit("Environment=A=1", "After=a.service")
    assert properties["Environment"].value[-2:] == ("MODEL=a b", "A=1")
    assert "\nAfter=a.service\n\n[Service]" in format_unit(properties)


def test_what_is_ours_is_refused() -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot set property KillMode: .*\(--property\)$"):
        unit("KillMode=process")


def test_a_wrong_property_of_a_file_is_a_fault_of_the_file() -> None:
    document = {"property": {"Nice": "much"}}
    settings = resolve_settings({}, {}, [("/srv/robot.systemd.yml", document)])
    with pytest.raises(DoraSystemdError) as caught:
        unit_properties(OPTIONS, SYSTEM, settings)
    assert caught.value.code == ExitCode.BAD_INPUT
    assert caught.value.message.endswith("to 'much' (/srv/robot.systemd.yml)")


def test_a_bad_environment_is_refused() -> None:
    with pytest.raises(DoraSystemdError, match="NOTIFY_SOCKET"):
        unit(context=UnitContext("/usr/bin/python3", False, None, {"NOTIFY_SOCKET": "/x"}))


SIZE = Kind[int](int | str, "a size", lambda v, _: parse_size(str(v)), lambda v: [format_size(v)])
LIMIT = Setting[int | None](
    "memory_limit", SIZE, None, "A limit.", ("--memory-limit",), property="MemoryMax"
)
NICE = Setting[str | None]("nice", TEXT, None, "Nice.", ("--nice",), property="Nice")


def test_a_setting_can_be_a_property() -> None:
    """What the limits need is one line in the table of settings."""
    flags = {"memory_limit": "4G", "property": ("CPUWeight=50",)}
    settings = resolve_settings(flags, {}, [], (*SETTINGS, LIMIT, NICE))
    properties = unit_properties(OPTIONS, SYSTEM, settings)
    assert properties["MemoryMax"] == Property("MemoryMax", "t", 4 * 1024**3)
    assert "Nice" not in properties
    flags["property"] = ("MemoryMax=1G",)
    settings = resolve_settings(flags, {}, [], (*SETTINGS, LIMIT, NICE))
    assert unit_properties(OPTIONS, SYSTEM, settings)["MemoryMax"].value == 1024**3


texts = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]))


@given(texts, texts)
def test_no_path_ends_the_line(dataflow: str, venv: str) -> None:
    """Whatever is in a path, the unit's text has the lines it should have, and the command."""
    options = RunnerOptions("a", UUID, f"/{dataflow}", "/", "/usr/bin/dora", venv=f"/{venv}")
    context = UnitContext("/usr/bin/python3", False)
    text = format_unit(unit(options=options, context=context))
    plain = format_unit(unit(options=with_grace(10 * SECOND), context=context))
    lines, expected = text.split("\n"), plain.split("\n")
    assert [line.partition("=")[0] for line in lines] == [
        line.partition("=")[0] for line in expected
    ]
    command = next(line for line in lines if line.startswith("ExecStart="))
    words = split_words(command.removeprefix("ExecStart=:"))
    assert options_from_command([word.replace("%%", "%") for word in words]).grace
    if "%%" not in dataflow + venv:
        assert options_from_command([word.replace("%%", "%") for word in words]) == options
