"""The unit file that `disable` keeps for a dataflow which runs, and when it goes."""

from pathlib import Path

import pytest

from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.decisions.unit.file import persistent_unit
from dora_systemd.decisions.unit.properties import UnitContext, format_unit, unit_properties
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.verbs.destroy import drop_all_disabled
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.enabled import trial_path
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.start.enable import disable_cell
from dora_systemd.verbs.stop import drop_disabled, reset_cells, stop_cells
from tests.unit.fakes.manager import FakeManager, options

NAME, UNIT = "robot", "dora-robot.service"
DOWN = {"ActiveState": "inactive"}


def file_of(name: str) -> str:
    """The unit file of an enabled dataflow."""
    context = UnitContext("/usr/bin/python3", False, "dora", {})
    text = format_unit(unit_properties(options(name), context, resolve_settings({}, {}, [])))
    return persistent_unit([text], options(name), False, "multi-user.target")


def copy_of(scope: Scope, unit: str = UNIT) -> Path:
    """What `disable` keeps."""
    return scope.runtime_root / "systemd/system" / unit


def disabled(manager: FakeManager, scope: Scope, name: str = NAME) -> Cell:
    """A dataflow that runs, and was disabled since."""
    unit = unit_name(name)
    lasting = manager.etc / "systemd/system" / unit
    lasting.parent.mkdir(parents=True, exist_ok=True)
    lasting.write_text(file_of(name))
    manager.add(options(name), FragmentPath=str(lasting), Transient=False)
    cell = Selector(name).find(manager)
    assert disable_cell(manager, scope, cell)
    manager.units[unit]["FragmentPath"] = str(copy_of(scope, unit))
    manager.after_job[unit] = DOWN
    manager.calls.clear()
    return cell


def test_it_goes_with_the_end(manager: FakeManager, scope: Scope) -> None:
    cell = disabled(manager, scope)
    drop_disabled(manager, scope, [UNIT])
    assert copy_of(scope).exists(), "it runs"
    stop_cells(manager, scope, [cell])
    assert not copy_of(scope).exists()
    assert manager.calls[-1] == ("reload",)


def test_one_reload_for_all(manager: FakeManager, scope: Scope) -> None:
    cells = [disabled(manager, scope, name) for name in ("one", "two", "three")]
    stop_cells(manager, scope, cells)
    assert manager.calls.count(("reload",)) == 1


def test_a_start_that_waits_needs_it(manager: FakeManager, scope: Scope) -> None:
    cell = disabled(manager, scope)
    manager.units[UNIT] |= {**DOWN, "Job": [7, "/job/7"]}
    manager.hold(UNIT)  # as its job does
    reset_cells(manager, scope, [cell])
    assert copy_of(scope).exists()


def test_a_failed_one_needs_it_until_it_is_reset(manager: FakeManager, scope: Scope) -> None:
    cell = disabled(manager, scope)
    manager.after_job[UNIT] = {"ActiveState": "failed"}
    stop_cells(manager, scope, [cell])
    assert copy_of(scope).exists()
    manager.units[UNIT] |= DOWN
    reset_cells(manager, scope, [cell])
    assert not copy_of(scope).exists()


def test_a_trial_may_go_back_to_it(manager: FakeManager, scope: Scope) -> None:
    cell = disabled(manager, scope)
    trial = trial_path(scope, UNIT)
    trial.parent.mkdir(parents=True)
    trial.write_text(file_of(NAME))
    stop_cells(manager, scope, [cell])
    assert copy_of(scope).exists()


@pytest.mark.parametrize(
    "unit, text",
    [
        (UNIT, "[Service]\nExecStart=/bin/true\n"),
        pytest.param(UNIT, file_of(NAME), id="of doractl export"),
        pytest.param(UNIT, file_of("other").partition("[Install]")[0], id="of another name"),
    ],
)
def test_files_of_others_stay(manager: FakeManager, scope: Scope, unit: str, text: str) -> None:
    path = copy_of(scope, unit)
    path.parent.mkdir(parents=True)
    path.write_text(text)
    manager.add(options(), FragmentPath=str(path), Transient=False)
    manager.after_job[UNIT] = DOWN
    stop_cells(manager, scope, [Selector(NAME).find(manager)])
    drop_all_disabled(manager, scope)
    assert path.exists()


def test_destroy_looks_for_what_systemctl_has_stopped(manager: FakeManager, scope: Scope) -> None:
    disabled(manager, scope)
    manager.units[UNIT] |= DOWN
    drop_all_disabled(manager, scope)
    assert not copy_of(scope).exists()


def test_a_lookup_that_fails_hides_no_outcome(
    manager: FakeManager, scope: Scope, monkeypatch: pytest.MonkeyPatch
) -> None:
    manager.add(options(), "failed")
    monkeypatch.setattr(manager, "unit_path", lambda: ["/opt/only"])
    (outcome,) = reset_cells(manager, scope, [Selector(NAME).find(manager)])
    assert not outcome.problem
