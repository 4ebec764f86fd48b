"""enable, disable and export against a fake systemd and real files."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.host.unit_files import put_unit_file, read_unit_file
from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.decisions.unit.file import says_the_same
from dora_systemd.decisions.unit.properties import UnitContext, format_unit, unit_properties
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.enabled import enabled_units
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.list import find_row
from dora_systemd.verbs.show import export_cell, unit_files
from dora_systemd.verbs.start.enable import (
    boot_target,
    disable_cell,
    enable_cell,
    install_unit_file,
    read_boot_unit,
    wait_until_forgotten,
)
from dora_systemd.verbs.start.logins import ensure_linger, linger_note
from dora_systemd.verbs.stop import stop_cells
from tests.unit.fakes.manager import FakeManager, ScopeIn, options
from tests.unit.fakes.programs import make_program

UNIT = "dora-robot.service"


def started(manager: FakeManager) -> Cell:
    """A running transient unit, with the fragment that systemd has for it."""
    context = UnitContext("/usr/bin/python3", False, "dora", {"A": "x 100% $B"})
    text = format_unit(unit_properties(options(), context, resolve_settings({}, {}, [])))
    fragment = manager.etc / "../run/systemd/transient" / UNIT
    fragment.parent.mkdir(parents=True)
    fragment.write_text(f"# This is a transient unit file\n{text}")
    manager.add(options(), FragmentPath=str(fragment), DropInPaths=[])
    return Selector("robot").find(manager)


def path_of(manager: FakeManager) -> Path:
    return manager.etc / "systemd/system" / UNIT


def test_a_lost_unit_is_looked_for_when_it_has_stopped(manager: FakeManager, scope: Scope) -> None:
    cell = started(manager)
    enable_cell(manager, scope, cell)
    manager.after_job[UNIT] = {"LoadState": "not-found", "ActiveState": "inactive", "Transient": 0}
    stop_cells(manager, scope, [cell])
    assert manager.calls[-1] == ("reload",)


def test_only_a_lost_unit_is_looked_for_in_the_files(manager: FakeManager, scope: Scope) -> None:
    enable_cell(manager, scope, started(manager))
    manager.calls.clear()
    assert Selector("robot").find_enabled(manager, scope).unit == UNIT
    del manager.units[UNIT]
    assert manager.calls == []
    with pytest.raises(DoraSystemdError, match="no dataflow named"):
        Selector("robot").find_enabled(manager, scope)  # this systemd does not read files
    assert manager.calls == [("reload",)]


def test_what_runs_goes_on(manager: FakeManager, scope: Scope) -> None:
    """No reload: it would keep the transient unit loaded when it has ended."""
    cell = started(manager)
    boot, is_news = enable_cell(manager, scope, cell)
    assert (boot.path, is_news) == (path_of(manager), True)
    assert manager.calls == [("enable", str(path_of(manager)))]
    text = path_of(manager).read_text()
    assert 'Environment="A=x 100%% $B"\n' in text
    assert "RequiresMountsFor=/srv\n" in text
    assert text.endswith("[Install]\nWantedBy=multi-user.target\n")
    assert enabled_units(manager, scope) == {UNIT}


def test_enabled_twice(manager: FakeManager, scope: Scope) -> None:
    cell = started(manager)
    enable_cell(manager, scope, cell)
    before = path_of(manager).stat()
    assert enable_cell(manager, scope, cell)[1] is False
    assert path_of(manager).stat().st_ino == before.st_ino


def test_a_file_of_another_version_is_written_anew(manager: FakeManager, scope: Scope) -> None:
    cell = started(manager)
    enable_cell(manager, scope, cell)
    text = path_of(manager).read_text()
    path_of(manager).write_text(text.replace("--name=robot", "--name=robot --future=1"))
    assert enable_cell(manager, scope, cell)[1] is True
    assert path_of(manager).read_text() == text


def test_what_another_version_has_started_cannot_be_enabled(
    manager: FakeManager, scope: Scope
) -> None:
    """The unit file would start a command line that this version refuses, at the next boot."""
    started(manager)
    ((program, argv, *rest),) = manager.units[UNIT]["ExecStart"]
    manager.units[UNIT]["ExecStart"] = [[program, [*argv[:-1], "--future=1", argv[-1]], *rest]]
    with pytest.raises(DoraSystemdError, match="another version of dora-systemd") as error:
        enable_cell(manager, scope, Selector("robot").find(manager))
    assert error.value.hint == "doractl list robot says how to start this version"
    assert not path_of(manager).exists()


def test_a_foreign_file_is_not_touched(manager: FakeManager, scope: Scope) -> None:
    cell = started(manager)
    path_of(manager).parent.mkdir(parents=True)
    path_of(manager).write_text("[Service]\nExecStart=/bin/true\n")
    for change in (enable_cell, disable_cell):
        with pytest.raises(DoraSystemdError, match=r"^cannot use .*: it already exists") as error:
            change(manager, scope, cell)
        assert error.value.code is ExitCode.NAME_IN_USE
    assert path_of(manager).read_text() == "[Service]\nExecStart=/bin/true\n"
    assert manager.calls == []


def test_a_masked_unit_is_not_touched(manager: FakeManager, scope: Scope) -> None:
    cell = started(manager)
    path_of(manager).parent.mkdir(parents=True)
    path_of(manager).symlink_to("/dev/null")
    with pytest.raises(DoraSystemdError, match="already exists"):
        enable_cell(manager, scope, cell)
    assert path_of(manager).is_symlink()


class Refusing(FakeManager):
    def enable_unit_files(self, names: object) -> bool:
        raise DoraSystemdError(f"cannot enable {names}: No space left on device")


def test_nothing_is_left_when_it_cannot_be_linked(tmp_path: Path, scope: Scope) -> None:
    manager = Refusing()
    manager.etc = tmp_path / "etc"
    cell = started(manager)
    with pytest.raises(DoraSystemdError, match="No space left"):
        enable_cell(manager, scope, cell)
    assert not path_of(manager).exists()


@pytest.mark.parametrize("before", [None, "of the last start\n"])
def test_a_failure_leaves_the_files_of_links_as_they_were(
    tmp_path: Path, scope: Scope, before: str | None
) -> None:
    manager = Refusing()
    manager.etc = tmp_path / "etc"
    boot = read_boot_unit(manager, scope, UNIT)
    links = [boot.path.with_name(f"doralink-robot:{one}.service") for one in ("a", "b")]
    boot.path.parent.mkdir(parents=True)
    for path in (*links, boot.path):
        put_unit_file(path, before)
    given = dict.fromkeys((path.name for path in links), "new")
    with pytest.raises(DoraSystemdError, match="No space left"):
        install_unit_file(manager, boot, "new", given)
    assert {read_unit_file(path) for path in (*links, boot.path)} == {before}
    links[1].unlink(missing_ok=True)
    links[1].mkdir()  # a file that cannot be written, after one that can
    with pytest.raises(DoraSystemdError, match="already exists"):
        install_unit_file(manager, boot, "new", given)
    assert {read_unit_file(path) for path in (links[0], boot.path)} == {before}


def test_an_error_in_a_unit_file_that_is_not_utf_8(manager: FakeManager) -> None:
    cell = started(manager)
    Path(manager.units[UNIT]["FragmentPath"]).write_bytes(b"[Unit]\n# f\xfcr\n")
    with pytest.raises(DoraSystemdError, match=r"service: line 2 is not UTF-8"):
        unit_files(manager, cell)


def test_attached_dataflows_cannot_outlive_their_terminal(
    manager: FakeManager, scope: Scope
) -> None:
    manager.add(options(attached=True))
    with pytest.raises(DoraSystemdError, match="doractl run"):
        enable_cell(manager, scope, Selector("robot").find(manager))
    with pytest.raises(DoraSystemdError, match="doractl run"):
        export_cell(manager, scope, Selector("robot").find(manager))


def test_disabled_while_the_transient_unit_runs(manager: FakeManager, scope: Scope) -> None:
    cell = started(manager)
    enable_cell(manager, scope, cell)
    manager.calls.clear()
    assert disable_cell(manager, scope, cell)
    assert manager.calls == [("disable", UNIT), ("reload",)]
    assert not path_of(manager).exists()
    assert enabled_units(manager, scope) == set()
    assert not disable_cell(manager, scope, cell)


def test_disabled_while_it_runs_from_its_file(manager: FakeManager, scope: Scope) -> None:
    """Without a file systemd would forget how to stop it."""
    cell = started(manager)
    enable_cell(manager, scope, cell)
    manager.units[UNIT] |= {"FragmentPath": str(path_of(manager)), "Transient": False}
    disable_cell(manager, scope, cell)
    runtime = scope.runtime_root / "systemd/system" / UNIT
    assert "[Install]" not in runtime.read_text()
    assert not path_of(manager).exists()
    manager.units[UNIT] |= {"FragmentPath": str(runtime)}
    enable_cell(manager, scope, cell)
    assert path_of(manager).exists()
    assert not runtime.exists()


def test_after_its_end_the_file_counts(
    manager: FakeManager, scope: Scope, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It stays enabled meanwhile, in case that this process is killed."""
    cell = started(manager)
    enable_cell(manager, scope, cell)
    manager.calls.clear()
    manager.after_job[UNIT] = {"ActiveState": "inactive"}
    mask = scope.runtime_root / "systemd/system.control/dora.target.wants" / UNIT
    real, seen = manager.reload, []

    def reload() -> None:
        real()
        is_hidden = mask.is_symlink() and str(mask.readlink()) == os.devnull
        seen.append((is_hidden, enabled_units(manager, scope)))
        manager.units[UNIT]["Transient"] &= not is_hidden

    monkeypatch.setattr(manager, "reload", reload)
    manager.units[UNIT]["Transient"] = True
    stop_cells(manager, scope, [cell])
    assert seen == [(True, frozenset({UNIT})), (False, frozenset({UNIT}))]
    assert manager.calls == [("StopUnit", UNIT), ("reload",), ("reload",)]
    assert not mask.parent.exists()


def test_what_descriptors_hold_is_let_go(manager: FakeManager) -> None:
    """As with FileDescriptorStorePreserve=, when a unit has ended."""
    unit = manager.add(options(), active="inactive", NFileDescriptorStore=6)
    wait_until_forgotten(manager, unit)
    assert ("close", unit) in manager.calls


class Held(FakeManager):
    """A manager that unloads a unit when it has been read often enough."""

    def read(self, unit: str, names: Sequence[str]) -> dict[str, Any]:
        if self.questions > 20 and unit == UNIT:
            self.units[unit]["Transient"] = False
        return super().read(unit, names)


@pytest.mark.parametrize("job", [0, 7])
@pytest.mark.parametrize("service", ["doranotice-hold@robot.service", "doranotice@robot.service"])
def test_a_start_waits_for_the_notice_of_a_failure(service: str, job: int) -> None:
    """As long as the service starts that reads the setting of the dataflow, and no longer."""
    manager = Held()
    unit = manager.add(options(), active="inactive")
    manager.units[service] = {"Job": [job, "/"]}
    if job:
        wait_until_forgotten(manager, unit, 0)
        assert unit in manager.unloaded
        return
    with pytest.raises(DoraSystemdError, match="systemd still holds the ended one"):
        wait_until_forgotten(manager, unit, 0)


def test_the_target(manager: FakeManager, scope: Scope) -> None:
    user = ScopeIn(is_user=True, uid=1000)
    assert boot_target(manager, scope) == "multi-user.target"
    assert boot_target(manager, user) == "default.target"
    manager.units["dora.target"] = {"LoadState": "loaded", "WantedBy": []}
    assert boot_target(manager, scope) == "multi-user.target"
    manager.units["dora.target"] = {"LoadState": "loaded", "WantedBy": ["multi-user.target"]}
    assert boot_target(manager, scope) == "dora.target"


def test_export_has_the_drop_ins_in_it(manager: FakeManager, scope: Scope, tmp_path: Path) -> None:
    cell = started(manager)
    drop_in = tmp_path / "override.conf"
    drop_in.write_text("[Service]\nNice=5\n")
    manager.units[UNIT]["DropInPaths"] = [str(drop_in)]
    text = export_cell(manager, scope, cell)
    assert text.count("[Service]") == 1
    assert "\nNice=5\n" in text
    assert "After=multi-user.target\n" in text


def test_list_marks_it(manager: FakeManager, scope: Scope) -> None:
    cell = started(manager)
    assert not find_row(manager, scope, "robot").enabled
    enable_cell(manager, scope, cell)
    assert find_row(manager, scope, "robot").enabled


@pytest.mark.parametrize(
    ("answers", "note"),
    [
        (["yes\n"], ""),
        (["no\n", 0], "lingering is now on"),
        (["no\n", 1], "as root: loginctl enable-linger root"),
        (["", 1], "as root: loginctl enable-linger root"),
    ],
)
def test_linger(
    answers: list[str | int], note: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said, *status = answers
    answer = f"*show-user*) printf '{said}';; *) exit {status[0] if status else 9};;"
    make_program(tmp_path / "bin/loginctl", f'case "$*" in {answer} esac')
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:{os.environ['PATH']}")
    assert note in ensure_linger(Scope(is_user=True, uid=0))
    assert (note == "") == (ensure_linger(Scope(is_user=False, uid=0)) == note)


@pytest.mark.parametrize(
    ("answer", "is_user", "note"),
    [
        ("no", True, "it ends when root logs out; "),
        ("no", False, ""),
        ("yes", True, ""),
        ("", True, ""),
    ],
)
def test_a_start_warns_that_logout_ends_it(
    answer: str, is_user: bool, note: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_program(tmp_path / "bin/loginctl", f"echo {answer}")
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:{os.environ['PATH']}")
    remedy = "to keep it running, as root: loginctl enable-linger root"
    assert linger_note(Scope(is_user=is_user, uid=0)) == (note and note + remedy)


CHECKED = "[Install]\nWantedBy=multi-user.target\nRequiredBy=boot-complete.target\n"


def test_a_boot_check_comes_and_goes(manager: FakeManager, scope: Scope) -> None:
    cell = started(manager)
    boot, is_news = enable_cell(manager, scope, cell, is_checked=True)
    text = path_of(manager).read_text()
    assert is_news
    assert "\nBefore=boot-complete.target\n" in text
    assert text.endswith(CHECKED)
    assert not enable_cell(manager, scope, cell, is_checked=True)[1]
    assert not enable_cell(manager, scope, cell)[1], "it stays until it is disabled"
    assert path_of(manager).read_text() == text
    manager.units[UNIT] |= {"FragmentPath": str(boot.path), "Transient": False}
    disable_cell(manager, scope, cell)
    assert "boot-complete" not in boot.runtime.read_text()
    assert not path_of(manager).exists()


def test_what_is_enabled_gets_a_boot_check(manager: FakeManager, scope: Scope) -> None:
    cell = started(manager)
    boot, _ = enable_cell(manager, scope, cell)
    before = boot.path.read_text()
    _, is_news = enable_cell(manager, scope, cell, is_checked=True)
    assert is_news
    assert boot.path.read_text().endswith(CHECKED)
    assert says_the_same(boot.path.read_text(), before), "a start uses the file as it is"


def test_no_boot_check_for_users(manager: FakeManager, tmp_path: Path) -> None:
    cell = started(manager)
    user = ScopeIn(is_user=True, uid=1000, root=tmp_path)
    with pytest.raises(DoraSystemdError, match="cannot check the boot") as caught:
        enable_cell(manager, user, cell, is_checked=True)
    assert caught.value.code is ExitCode.USAGE
    assert not path_of(manager).exists()


def test_a_part_is_enabled_on_its_head(manager: FakeManager, scope: Scope) -> None:
    manager.add(options(machine="gpu", head="robot-1"))
    with pytest.raises(DoraSystemdError, match="its head is another machine") as caught:
        enable_cell(manager, scope, Selector("robot").find(manager))
    assert caught.value.hint == "on robot-1: doractl enable robot"
