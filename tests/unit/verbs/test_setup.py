"""setup and setup --remove on a root of their own."""

from pathlib import Path

import pytest

from dora_systemd.decisions.unit.setup_files import is_ours, setup_files
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.setup import (
    data_root,
    plan_setup,
    put_in_place,
    refuse_if_needed,
    take_away,
    tell_systemd,
    unsearched,
)
from tests.unit.checkout import CHECKOUT
from tests.unit.fakes.manager import FakeManager

SYSTEM, USER = Scope(is_user=False, uid=0), Scope(is_user=True, uid=1000)


def tree(root: Path) -> dict[str, str]:
    """Every file and link below `root` with its text or its target."""
    found = (path for path in root.rglob("*") if path.is_symlink() or path.is_file())
    return {
        str(path.relative_to(root)): f"-> {path.readlink()}"
        if path.is_symlink()
        else path.read_text()
        for path in found
    }


@pytest.mark.parametrize("scope", [SYSTEM, USER])
def test_put_in_place_and_taken_away(scope: Scope, tmp_path: Path) -> None:
    tmp_path /= "share"
    (tmp_path / "lib").mkdir(parents=True)
    (tmp_path / "other").write_text("x")
    before = tree(tmp_path)
    written = put_in_place(plan_setup(scope, tmp_path))
    assert len(written) == len(tree(tmp_path)) - len(before)
    # Again, and there is nothing to do.
    assert put_in_place(plan_setup(scope, tmp_path)) == []
    assert sorted(take_away(plan_setup(scope, tmp_path))) == sorted(written)
    assert tree(tmp_path) == before
    left = {path.name for path in tmp_path.rglob("*") if path.is_dir()}
    assert left <= {"etc", "usr", "local", "lib", "share", "man"}
    assert take_away(plan_setup(scope, tmp_path)) == []


def test_the_links_lead_to_the_target(tmp_path: Path) -> None:
    put_in_place(plan_setup(SYSTEM, tmp_path))
    for place in ("system/multi-user.target.wants", "user/default.target.wants"):
        link = tmp_path / "usr/local/lib/systemd" / place / "dora.target"
        assert link.resolve() == (link.parent.parent / "dora.target").resolve()
        assert link.exists()


def test_everything_of_the_project_has_a_place() -> None:
    manuals = [path.name for path in (CHECKOUT / "packaging/man").iterdir()]
    sources = {file.source for file in setup_files(False, manuals)}
    directories = {
        "templates": CHECKOUT / "units/templates",
        "completions": CHECKOUT / "packaging/completions",
        "man": CHECKOUT / "packaging/man",
    }
    there = {(kind, path.name) for kind, where in directories.items() for path in where.iterdir()}
    assert sources == there
    assert all(is_ours((directories[kind] / name).read_text()) for kind, name in there)


@pytest.mark.parametrize("is_link", [False, True])
def test_foreign_files_stay(is_link: bool, tmp_path: Path) -> None:
    path = tmp_path / "usr/local/lib/systemd/system/dora.slice"
    if is_link:
        path = tmp_path / "usr/local/lib/systemd/system/multi-user.target.wants/dora.target"
    path.parent.mkdir(parents=True)
    path.write_text("[Slice]\n")
    with pytest.raises(DoraSystemdError, match="already exists") as caught:
        plan_setup(SYSTEM, tmp_path)
    assert caught.value.code is ExitCode.NAME_IN_USE
    assert path.read_text() == "[Slice]\n"


def test_an_older_version_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "usr/local/lib/systemd/system/dora.slice"
    path.parent.mkdir(parents=True)
    path.write_text("# of dora-systemd 0.0\n[Slice]\n")
    assert path in put_in_place(plan_setup(SYSTEM, tmp_path))
    assert "man:dora-systemd(7)" in path.read_text()


def test_the_files_of_a_package_are_left_to_apt(tmp_path: Path) -> None:
    """Its doractl has neither the manuals nor the completions beside itself."""
    with pytest.raises(DoraSystemdError, match="the files of a package") as caught:
        plan_setup(SYSTEM, tmp_path, tmp_path / "dist-packages/dora_systemd")
    assert "apt remove" in caught.value.hint


def test_a_relative_home_is_not_below_the_current_directory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    monkeypatch.setenv("HOME", "relative")
    assert data_root(USER).is_absolute()


def reach_nothing(_scope: Scope) -> FakeManager:
    raise DoraSystemdError("cannot reach systemd", "", ExitCode.NO_SYSTEMD)


def test_what_is_in_use_stays(tmp_path: Path) -> None:
    manager = FakeManager()
    manager.etc = tmp_path
    refuse_if_needed(lambda _scope: manager, SYSTEM)
    manager.enable_unit_files(["dora-robot.service"])
    with pytest.raises(DoraSystemdError, match="a boot starts robot") as caught:
        refuse_if_needed(lambda _scope: manager, SYSTEM)
    assert caught.value.hint == "doractl --system disable robot"
    assert caught.value.code is ExitCode.FAILURE


def test_what_a_later_boot_uses_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The user's manager does not run, as after the last logout."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    refuse_if_needed(reach_nothing, USER)
    links = tmp_path / "systemd/user/dora.target.wants"
    links.mkdir(parents=True)
    (links / "dora-robot.service").symlink_to("../dora-robot.service")
    with pytest.raises(DoraSystemdError, match="a boot starts robot"):
        refuse_if_needed(reach_nothing, USER)


def test_a_directory_that_systemd_does_not_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """XDG_DATA_HOME is set in the shell only."""
    monkeypatch.setenv("XDG_DATA_HOME", "/home/joe/data")
    manager = FakeManager()
    manager.units["dora.target"] = {"LoadState": "loaded"}
    assert unsearched(lambda _scope: manager, USER) == ()
    manager.units["dora.target"] = {"LoadState": "not-found"}
    (warning,) = unsearched(lambda _scope: manager, USER)
    assert warning.startswith("systemd does not search /home/joe/data for units: unset XDG")
    assert unsearched(reach_nothing, USER) == ()
    assert unsearched(lambda _scope: manager, SYSTEM) == ()


def test_a_gateway_of_another_installation_ends() -> None:
    """Its Python may be gone; the port stays open."""
    manager = FakeManager()
    unit = Path("/usr/local/lib/systemd/system/dora-gateway.service")
    manager.units[unit.name] = {"ActiveState": "active"}
    for written, ended in (([unit.with_name("dora.slice")], False), ([unit], True)):
        assert tell_systemd(lambda _scope: manager, USER, written) == ()
        assert (("StopUnit", unit.name) in manager.calls) is ended


def test_without_systemd_the_files_are_enough() -> None:
    assert tell_systemd(reach_nothing, USER) == ()
