"""A name that is to be started: free, in use, enabled with the same settings or with others."""

import os
import pwd
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.host.unit_files import write_link
from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.decisions.unit.file import runner_of
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.start.plan import Plan
from dora_systemd.verbs.start.start import (
    place_unit_file,
    refuse_unit_file,
    require_free_name,
    with_known_uuid,
)
from dora_systemd.verbs.start.unit import plan_properties
from tests.unit.fakes.manager import UUID, FakeManager, options

UNIT = "dora-robot.service"
OTHER = "11111111-e29b-41d4-a716-446655440000"


@pytest.fixture
def manager(manager: FakeManager) -> FakeManager:
    manager.units["dora.target"] = {"LoadState": "loaded", "WantedBy": ["multi-user.target"]}
    return manager


def make_plan(scope: Scope, uuid: str = UUID, **flags: object) -> Plan:
    return Plan(scope, options(uuid=uuid), resolve_settings(flags, {}, []), None, {"PATH": "/bin"})


def place(manager: FakeManager, plan: Plan, want_boot: bool = False) -> bool:
    boot = require_free_name(manager, plan.scope, UNIT)
    plan = with_known_uuid(plan, boot)
    return place_unit_file(manager, plan, plan_properties(plan, manager)[0], boot, want_boot)


def unit_file(manager: FakeManager) -> Path:
    return manager.etc / "systemd/system" / UNIT


def test_a_free_name(manager: FakeManager, scope: Scope) -> None:
    boot = require_free_name(manager, scope, UNIT)
    assert (boot.path, boot.text, boot.is_enabled) == (unit_file(manager), None, False)
    manager.questions = 0
    assert not place(manager, make_plan(scope))
    assert manager.questions == 3, "LoadState, UnitPath and Transient, each once"
    assert manager.calls == []


def test_old_links_go_when_the_new_file_is_there(
    manager: FakeManager, scope: Scope, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = make_plan(scope)
    spread = plan._replace(options=plan.options._replace(placed=(Placed("a", "gpu"),)))
    place(manager, spread, want_boot=True)
    link = unit_file(manager).with_name("doralink-robot:gpu.service")
    link.write_text("")
    before = unit_file(manager).read_text()

    def refuse(_names: object) -> bool:
        raise DoraSystemdError("No space left on device")

    with monkeypatch.context() as context:
        context.setattr(manager, "enable_unit_files", refuse)
        with pytest.raises(DoraSystemdError, match="No space left"):
            place(manager, plan, want_boot=True)
    assert (link.exists(), unit_file(manager).read_text()) == (True, before)
    place(manager, plan, want_boot=True)
    assert not link.exists()


def test_a_name_of_one_that_is_stopping(manager: FakeManager, scope: Scope) -> None:
    manager.add(options(), active="deactivating")
    with pytest.raises(DoraSystemdError, match=f"{UUID} of that name is stopping") as caught:
        require_free_name(manager, scope, UNIT)
    assert caught.value.code is ExitCode.NAME_IN_USE
    assert caught.value.hint.startswith("doractl stop robot waits for its end")


def test_a_name_of_one_that_waits_for_its_restart(manager: FakeManager, scope: Scope) -> None:
    manager.add(options(), active="activating", SubState="auto-restart")
    with pytest.raises(DoraSystemdError, match="of that name waits for its restart from /srv/"):
        require_free_name(manager, scope, UNIT)


@pytest.mark.parametrize("state", ["active", "activating", "reloading"])
def test_a_name_in_use(state: str, manager: FakeManager, scope: Scope) -> None:
    manager.add(options(), active=state, InactiveExitTimestamp=1_700_000_000_000_000)
    with pytest.raises(DoraSystemdError) as caught:
        require_free_name(manager, scope, UNIT)
    assert caught.value.code is ExitCode.NAME_IN_USE
    for part in (UUID, "/srv/robot.yml", "since 2023-11-1"):
        assert part in caught.value.message
    assert manager.calls == []


def test_a_failed_one_is_forgotten(manager: FakeManager, scope: Scope) -> None:
    manager.add(options(), active="failed")
    place(manager, make_plan(scope))
    assert manager.calls == [("reset", UNIT)]


def test_a_failed_one_is_kept_until_nothing_can_refuse_the_start(
    manager: FakeManager, scope: Scope
) -> None:
    manager.add(options(), active="failed")
    require_free_name(manager, scope, UNIT)
    assert manager.calls == []
    manager.units.pop(UNIT)
    place(manager, make_plan(scope), want_boot=True)
    manager.add(options(), active="failed")
    manager.calls.clear()
    with pytest.raises(DoraSystemdError):
        place(manager, make_plan(scope, memory_limit="1G"))
    assert manager.calls == []


@pytest.mark.parametrize("facts", [{"ExecStart": []}, {"LoadState": "bad-setting"}])
def test_a_unit_that_is_not_ours(facts: dict[str, Any], manager: FakeManager, scope: Scope) -> None:
    manager.add(options(), active="failed", **facts)
    with pytest.raises(DoraSystemdError, match="already exists") as caught:
        require_free_name(manager, scope, UNIT)
    assert caught.value.code is ExitCode.NAME_IN_USE
    assert manager.calls == []


@pytest.mark.parametrize("text", ["", "nonsense", "[Service]\nExecStart=/bin/sleep 1\n"])
def test_a_file_that_is_not_ours(text: str, manager: FakeManager, scope: Scope) -> None:
    path = unit_file(manager)
    path.parent.mkdir(parents=True)
    path.write_text(text)
    with pytest.raises(DoraSystemdError, match="not doractl's") as caught:
        require_free_name(manager, scope, UNIT)
    assert caught.value.code is ExitCode.NAME_IN_USE
    assert path.read_text() == text


def test_started_and_enabled(manager: FakeManager, scope: Scope) -> None:
    assert place(manager, make_plan(scope), want_boot=True)
    text = unit_file(manager).read_text()
    found = runner_of(text)
    assert found is not None
    assert found == options()
    assert text.endswith("\n[Install]\nWantedBy=dora.target\n")
    assert manager.calls == [("enable", str(unit_file(manager))), ("reload",)]


def test_the_same_again_is_started_from_its_file(manager: FakeManager, scope: Scope) -> None:
    place(manager, make_plan(scope), want_boot=True)
    before = unit_file(manager).read_text()
    manager.calls.clear()
    # However the target came about: it says nothing about the dataflow.
    del manager.units["dora.target"]
    assert place(manager, make_plan(scope, uuid=OTHER))
    assert unit_file(manager).read_text() == before
    # systemd does not know the unit, and its file is there: it has to look again.
    assert manager.calls == [("reload",)]


def test_other_settings_are_refused(manager: FakeManager, scope: Scope) -> None:
    place(manager, make_plan(scope), want_boot=True)
    before = unit_file(manager).read_text()
    with pytest.raises(DoraSystemdError, match="enabled with other settings") as caught:
        place(manager, make_plan(scope, property=("Nice=5",)))
    assert caught.value.code is ExitCode.NAME_IN_USE
    assert "--enable" in caught.value.hint
    assert unit_file(manager).read_text() == before


def test_other_settings_replace_on_request(manager: FakeManager, scope: Scope) -> None:
    """The UUID stays with the file of the dataflow."""
    place(manager, make_plan(scope), want_boot=True)
    assert place(manager, make_plan(scope, uuid=OTHER, property=("Nice=5",)), want_boot=True)
    text = unit_file(manager).read_text()
    assert "\nNice=5\n" in text
    assert f"--uuid={UUID}" in text


def test_another_dataflow_has_another_uuid(manager: FakeManager, scope: Scope) -> None:
    place(manager, make_plan(scope), want_boot=True)
    plan = make_plan(scope, uuid=OTHER)
    plan = plan._replace(options=plan.options._replace(dataflow="/srv/other.yml"))
    assert place(manager, plan, want_boot=True)
    assert f"--uuid={OTHER}" in unit_file(manager).read_text()


def test_a_disabled_one_gives_way(manager: FakeManager, scope: Scope) -> None:
    place(manager, make_plan(scope), want_boot=True)
    manager.disable_unit_files([UNIT])
    assert not place(manager, make_plan(scope))
    assert not unit_file(manager).exists()


def test_run_refuses_an_enabled_name(manager: FakeManager, scope: Scope) -> None:
    place(manager, make_plan(scope), want_boot=True)
    with pytest.raises(DoraSystemdError, match="it is enabled"):
        refuse_unit_file(require_free_name(manager, scope, UNIT))


def test_an_ended_transient_one_makes_room_for_its_file(manager: FakeManager, scope: Scope) -> None:
    place(manager, make_plan(scope), want_boot=True)
    manager.add(options(), active="failed")
    manager.calls.clear()
    assert place(manager, make_plan(scope))
    assert manager.calls == [("reset", UNIT), ("reload",), ("reload",)]


def test_what_a_killed_start_has_hidden_is_wanted_again(manager: FakeManager, scope: Scope) -> None:
    place(manager, make_plan(scope), want_boot=True)
    manager.add(options(), active="inactive", Transient=False)
    mask = scope.runtime_root / "systemd/system.control/dora.target.wants" / UNIT
    write_link(mask, os.devnull)
    manager.calls.clear()
    assert place(manager, make_plan(scope))
    assert manager.calls == [("reload",)]
    assert not mask.parent.exists()


def user(name: str) -> pwd.struct_passwd:
    return pwd.struct_passwd((name, "x", 1000, 1000, "", f"/home/{name}", "/bin/sh"))


def test_the_unit_file_of_another_user_stays(manager: FakeManager, scope: Scope) -> None:
    """A user chooses the name of a directory, from which comes that of a dataflow."""
    place(manager, make_plan(scope)._replace(user=user("alice")), want_boot=True)
    text = unit_file(manager).read_text()
    plan = make_plan(scope, OTHER)._replace(user=user("mallory"))
    with pytest.raises(DoraSystemdError) as caught:
        place(manager, plan, want_boot=True)
    assert caught.value.code is ExitCode.NAME_IN_USE
    assert "that name is alice's, and" in caught.value.message
    assert unit_file(manager).read_text() == text
    settings = make_plan(scope, user="mallory").settings
    assert place(manager, plan._replace(settings=settings), want_boot=True)
    assert "User=mallory\n" in unit_file(manager).read_text()
