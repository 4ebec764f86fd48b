"""The start of a plan: names, stages, failures, what is printed."""

from typing import Any

import pytest

from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.start.plan import Plan
from dora_systemd.verbs.start.start_unit import Started, format_started, start_unit
from dora_systemd.verbs.start.unit import format_plan, plan_properties
from tests.unit.fakes.manager import UUID, FakeManager, options

UNIT = "dora-robot.service"
SCOPE = Scope(is_user=True, uid=1000)


def make_plan(**flags: object) -> Plan:
    settings = resolve_settings(flags, {}, [])
    return Plan(SCOPE, options(), settings, None, {"PATH": "/bin"})


def test_stages_are_told_while_it_starts() -> None:
    manager = FakeManager()
    manager.stages = ["0/3 nodes ready", "", "3/3 nodes ready"]
    told: list[str] = []
    started = start_unit(manager, SCOPE, options(), [], told.append, wait=True)
    assert told == ["0/3 nodes ready", "3/3 nodes ready"]
    assert started == Started(UUID, "robot", UNIT, is_ready=True)


@pytest.mark.parametrize(
    ("result", "facts", "reason"),
    [
        ("failed", {"StatusText": "failed: node a: exit code 1"}, "node a: exit code 1"),
        ("canceled", {}, "it was stopped while it started"),
        ("dependency", {}, "a unit that it needs failed"),
        ("done", {"ActiveState": "failed", "StatusText": "failed: gone"}, "gone"),
    ],
)
def test_a_start_that_fails(result: str, facts: dict[str, Any], reason: str) -> None:
    manager = FakeManager()
    manager.add(options(), active="inactive")
    manager.job_results[UNIT] = result
    manager.after_job[UNIT] = facts
    with pytest.raises(DoraSystemdError) as caught:
        start_unit(manager, SCOPE, options(), [], None, wait=True)
    assert caught.value.message == f"cannot start robot: {reason}"
    assert caught.value.code is ExitCode.FAILURE


def test_a_refusal_ends_the_links() -> None:
    manager = FakeManager()
    manager.add(options(), active="inactive")
    manager.job_results[UNIT] = "failed"
    said = "failed: cannot reach machine gpu (no route): no answer within 30s"
    manager.after_job[UNIT] = {"ActiveState": "failed", "StatusText": said, "ExecMainStatus": 68}
    link = "doralink-robot:gpu.service"
    with pytest.raises(DoraSystemdError) as caught:
        start_unit(manager, SCOPE, options(), [], None, wait=True, beside=[(link, [])])
    assert caught.value.message.startswith("cannot reach machine gpu")
    assert caught.value.code is ExitCode.NO_HOST
    assert ("StopUnit", link) in manager.calls


def test_what_start_prints() -> None:
    assert format_started(Started("u", "robot", UNIT, is_ready=True)) == (
        "Dataflow started: u\n"
        "Name: robot\n"
        "Unit: dora-robot.service\n"
        "\n"
        "Use 'doractl stop robot' to stop\n"
        "Use 'doractl list' to view status\n"
        "Use 'doractl logs robot' to view logs"
    )
    assert format_started(Started("u", "robot", UNIT, is_ready=False)).startswith(
        "Dataflow starting: u\n"
    )


def test_properties_for_an_older_systemd() -> None:
    plan = make_plan(property=("RestartMode=direct",))
    manager = FakeManager()
    names = [one.name for one in plan_properties(plan, manager)[0].values()]
    assert "DelegateSubgroup" in names
    manager.systemd = "252.39-1~deb12u1"
    properties, warnings = plan_properties(plan, manager)
    assert "DelegateSubgroup" not in [one.name for one in properties.values()]
    assert len(warnings) == 1
    assert "RestartMode" in warnings[0]


def test_warnings_about_limits() -> None:
    plan = make_plan(device=("/dev/null", "/dev/nowhere"), nice="-5", realtime="20")
    properties, warnings = plan_properties(plan, FakeManager())
    assert warnings == (
        "there is no device /dev/nowhere",
        "devices cannot be closed in user scope",
        "the nice value -5 needs LimitNICE= of the user's manager",
    )
    assert properties["CPUSchedulingPriority"].value == 20


def test_plan_as_text() -> None:
    text = format_plan(make_plan(), FakeManager)
    assert text.startswith(f"# {UNIT}\n# source: /srv/robot.yml\n[Unit]\n")
    assert "Environment=PATH=/bin\n" in text
    assert "[Install]" not in text
    at_boot = format_plan(make_plan(), FakeManager, "dora.target")
    assert at_boot.endswith("\n[Install]\nWantedBy=dora.target\n")


def test_the_text_has_what_this_systemd_has() -> None:
    manager = FakeManager()
    assert "\nDelegateSubgroup=" in format_plan(make_plan(), lambda: manager)
    manager.systemd = "252.39-1~deb12u1"
    assert "\nDelegateSubgroup=" not in format_plan(make_plan(), lambda: manager)


def no_manager() -> FakeManager:
    raise DoraSystemdError("cannot reach systemd", "", ExitCode.NO_SYSTEMD)


def test_the_text_needs_no_systemd() -> None:
    assert "\nDelegateSubgroup=" in format_plan(make_plan(), no_manager)


NEW = ("FileDescriptorStorePreserve=on-success", "PrivateBPF=yes")


def test_what_only_a_newer_systemd_knows_is_passed_on_with_a_note() -> None:
    plan = make_plan(property=NEW)
    manager = FakeManager()
    manager.systemd, manager.types = "262-1", {"PrivateBPF": "b"}
    properties, warnings = plan_properties(plan, manager)
    assert properties["FileDescriptorStorePreserve"].value == "on-success"
    assert properties["PrivateBPF"] == ("PrivateBPF", "b", True)
    assert warnings == tuple(
        f"{key}= is passed on as it is: only systemd 262 can judge it"
        for key in ("FileDescriptorStorePreserve", "PrivateBPF")
    )
    text = format_plan(plan, lambda: manager)
    assert f"{NEW[0]}\n" in text
    assert f"{NEW[1]}\n" in text


@pytest.mark.parametrize("assignment", NEW)
def test_what_this_systemd_lacks_too_is_refused(assignment: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        plan_properties(make_plan(property=(assignment,)), FakeManager())
    assert caught.value.code is ExitCode.USAGE


def test_fake_and_real_manager_have_the_same_methods() -> None:
    from dora_systemd.adapters.bus.manager import Manager
    from dora_systemd.adapters.bus.systemd import Bus

    wanted = {name for name in vars(Manager) if not name.startswith("_")}
    assert wanted <= vars(Bus).keys()
    assert wanted <= vars(FakeManager).keys()
