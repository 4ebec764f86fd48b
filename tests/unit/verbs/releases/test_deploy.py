"""Whole deploys in user scope."""

import os
import pwd
import stat
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from dora_systemd import __version__
from dora_systemd.adapters.releases.store import locked
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.releases.copy import copy_project
from dora_systemd.verbs.releases.deploy import compare
from dora_systemd.verbs.releases.listing import refuse_on_trial
from dora_systemd.verbs.releases.source import find_source
from dora_systemd.verbs.releases.trial import read_standing
from tests.unit.fakes.deploys import FLOW, UNIT, Bench
from tests.unit.fakes.manager import options


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return Bench(tmp_path)


def refused(bench: Bench, **flags: object) -> DoraSystemdError:
    with pytest.raises(DoraSystemdError) as caught:
        bench.deploy(**flags)  # type: ignore[arg-type]
    return caught.value


def test_a_first_deploy(bench: Bench) -> None:
    bench.write("a.py", "print()")
    done = bench.deploy()
    manifest = bench.store.manifest(done.release)
    assert done == (manifest.uuid, "robot", UNIT, manifest.id, "", 2, 36, 36, False)
    assert len(manifest.uuid) == 36
    facts = (manifest.name, manifest.dataflow, manifest.source, manifest.user, manifest.revision)
    assert facts == ("robot", "dataflow.yml", str(bench.project), "", "")
    made_by = {"doractl": __version__, "systemd": bench.manager.systemd}
    if os.geteuid() == 0:
        made_by |= {"dora": "1.1.0", "python": "3.12.1"}
    assert made_by.items() <= manifest.versions.items()
    sizes = {path: (one.size, one.is_built) for path, one in manifest.files.items()}
    assert sizes == {"a.py": (7, False), "dataflow.yml": (len(FLOW), False)}
    assert bench.texts[0] == "copying: 0B of 36B"
    assert bench.texts[-5:] == [
        *("copying: 36B of 36B", "copied: 2 files, 36B, 36B of it new", "checking", "trial: up"),
        f"trial of {done.release}: passed",
    ]
    tree = bench.store.tree(done.release)
    text = bench.store.unit(done.release)
    assert f"--working-directory={tree} --dora={bench.dora}" in text
    assert f"{tree}/dataflow.yml\n" in text
    assert f"release {done.release}\n" in text
    assert f"--uuid={manifest.uuid}" in text
    assert text.endswith("[Install]\nWantedBy=default.target\n")
    assert (bench.manager.etc / "systemd/user" / UNIT).read_text() == text
    standing = read_standing(bench.manager, bench.scope, UNIT)
    assert (standing.current, standing.trial, standing.boot.is_enabled) == (done.release, "", True)
    assert bench.releases == {done.release: "current"}
    assert bench.warnings == []


def test_the_next_one_shares_what_is_the_same(bench: Bench) -> None:
    first = bench.deploy()
    bench.write("a.py", "print(2)")
    bench.write("b.py", "")
    changes = {"added": ["b.py"], "changed": ["a.py"], "removed": []}
    assert compare(bench.manager, bench.scope, bench.start()) == (first.release, changes)
    second = bench.deploy()
    assert second == (first.uuid, "robot", UNIT, second.release, first.release, 3, 37, 8, False)
    assert second.release > first.release
    trees = [bench.store.tree(one.release) for one in (first, second)]
    is_same = [(trees[0] / name).samefile(trees[1] / name) for name in ("dataflow.yml", "a.py")]
    assert is_same == [True, False]
    assert bench.releases == {first.release: "proved", second.release: "current"}
    nothing: dict[str, list[str]] = {"added": [], "changed": [], "removed": []}
    assert compare(bench.manager, bench.scope, bench.start()) == (second.release, nothing)
    (bench.project / "b.py").unlink()
    nothing["removed"] = ["b.py"]
    assert compare(bench.manager, bench.scope, bench.start()) == (second.release, nothing)


def test_a_release_that_fails_stays_to_be_looked_at(bench: Bench) -> None:
    first = bench.deploy()
    bench.manager.state = "failed"
    error = refused(bench)
    (latest,) = {*bench.releases} - {first.release}
    assert error.code is ExitCode.ROLLED_BACK
    assert error.message.startswith(f"release {latest} of robot was rolled back: ")
    assert error.hint == f"{first.release} runs again; doractl why robot shows more"
    assert bench.releases == {first.release: "current", latest: "failed"}
    assert bench.manager.units[UNIT]["ActiveState"] == "active"
    standing = read_standing(bench.manager, bench.scope, UNIT)
    assert (standing.current, standing.path.exists()) == (first.release, False)
    # What is compared, and shared, is what runs, and not the newest one.
    assert compare(bench.manager, bench.scope, bench.start())[0] == first.release


def test_a_first_release_that_fails_leaves_nothing_running(bench: Bench) -> None:
    bench.manager.state = "failed"
    assert refused(bench).hint == "nothing of it runs; doractl why robot shows more"
    assert ("StopUnit", UNIT) in bench.manager.calls
    assert [*bench.releases.values()] == ["failed"]
    bench.manager.state = "active"
    uuid = bench.store.manifest(*bench.releases).uuid
    assert bench.deploy().uuid == uuid, "it is the same dataflow"


def test_old_releases_go(bench: Bench) -> None:
    made = [bench.deploy(keep=2).release for _ in range(4)]
    assert [*bench.releases] == made[2:]
    bench.manager.state = "failed"
    refused(bench, keep=1)
    assert [*bench.releases][:2] == made[2:], "what runs, and the one before it, stay"
    assert len(bench.releases) == 3


@pytest.mark.skipif(os.geteuid() != 0, reason="only root has systemd make the check")
def test_a_check_that_refuses_leaves_nothing(bench: Bench) -> None:
    bench.manager.said = b"failed: cannot run TREE/a.py: no; hint: correct TREE/a.py\n"
    bench.manager.status = 78
    error = refused(bench)
    texts = (error.message, error.hint)
    assert texts == (f"cannot run {bench.project}/a.py: no", f"correct {bench.project}/a.py")
    assert not bench.store.path.exists()
    assert not any(call[0] == "RestartUnit" for call in bench.manager.calls)


def test_what_start_has_started_is_not_touched(bench: Bench) -> None:
    bench.manager.add(options())
    error = refused(bench)
    assert error.code is ExitCode.NAME_IN_USE
    assert bench.manager.calls == []
    assert not bench.store.path.exists()


def test_a_deploy_that_cannot_begin_leaves_no_release(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = bench.deploy()
    monkeypatch.setattr(bench.manager, "reload", lambda: bench.fail("cannot reload"))
    assert refused(bench).message == "cannot reload"
    assert [*bench.releases] == [first.release]


@pytest.mark.parametrize("want_boot", [True, False])
def test_whether_it_is_enabled(bench: Bench, want_boot: bool) -> None:
    bench.deploy(want_boot=want_boot)
    assert any(call[0] == "enable" for call in bench.manager.calls) is want_boot
    assert read_standing(bench.manager, bench.scope, UNIT).boot.is_enabled is want_boot


def test_a_damaged_disk_is_told(bench: Bench) -> None:
    for name in ("a.py", "b.py", "c.py"):
        bench.write(name, "print()")
    first = bench.deploy()
    for name in ("a.py", "b.py"):
        path = bench.store.tree(first.release) / name
        path.parent.chmod(0o700)
        path.chmod(0o600)
        path.write_text("printx)")
    second = bench.deploy()
    damaged = f"release {first.release} is damaged: a.py and 1 more changed on the disk"
    assert bench.warnings == [f"{damaged}; the new release has its own copy; check the disk"]
    assert (bench.store.tree(second.release) / "a.py").read_text() == "print()"


def test_a_full_disk(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    full = SimpleNamespace(f_bavail=0, f_frsize=4096)
    monkeypatch.setattr(os, "statvfs", lambda _path: full)
    error = refused(bench)
    assert error.message == f"cannot use {bench.store.path}: No space left on device"
    assert (error.hint, error.code) == ("see df", ExitCode.FAILURE)
    assert bench.releases == {}


@pytest.mark.parametrize(("has_user", "mode"), [(True, 0o750), (False, 0o700)])
def test_the_group_of_its_user_may_enter_a_release(has_user: bool, mode: int, bench: Bench) -> None:
    user = pwd.getpwuid(os.geteuid()) if has_user else None
    source = find_source(bench.scope, bench.start(), False)
    source = replace(source, plan=source.plan._replace(user=user))
    with locked(bench.store):
        standing = read_standing(bench.manager, bench.scope, UNIT)
        given = bench.scope, source, bench.store, standing, 0, bench.steps.append
        made = copy_project(bench.manager, *given).manifest
    release = bench.store.release(made.id).stat()
    assert (stat.S_IMODE(release.st_mode), release.st_gid) == (mode, os.getegid())


def test_what_is_shared_is_told(bench: Bench) -> None:
    venv = bench.project.parent / "venv"
    (venv / "bin").mkdir(parents=True)
    (venv / "bin/python").symlink_to(sys.executable)
    bench.deploy(venv=str(venv))
    shared = f"all releases share the virtual environment {venv}: pip changes all of them"
    assert bench.warnings == [shared]


def test_a_directory_above_the_dataflow(bench: Bench) -> None:
    (bench.project / "flows").mkdir()
    (bench.project / "dataflow.yml").rename(bench.project / "flows/dataflow.yml")
    bench.project /= "flows"
    done = bench.deploy(working_directory=str(bench.project.parent))
    tree = bench.store.tree(done.release)
    text = bench.store.unit(done.release)
    assert f"--working-directory={tree} " in text
    assert f"{tree}/flows/dataflow.yml\n" in text


def test_other_verbs_wait_for_the_end_of_a_trial(bench: Bench) -> None:
    found: list[str] = []

    def look() -> None:
        cell = read_standing(bench.manager, bench.scope, UNIT).cell
        assert cell is not None
        with pytest.raises(DoraSystemdError) as caught:
            refuse_on_trial(bench.scope, cell, "set limits of")
        found.append(f"{caught.value.message}; {caught.value.hint}")

    bench.manager.on_start = look
    release = bench.deploy().release
    assert found == [
        f"cannot set limits of robot: release {release} is on trial; "
        "wait until that has ended; doractl releases robot shows it"
    ]
    cell = read_standing(bench.manager, bench.scope, UNIT).cell
    assert cell is not None
    refuse_on_trial(bench.scope, cell, "set limits of")


def test_a_path_that_leads_out_of_the_project(bench: Bench) -> None:
    bench.write("dataflow.yml", FLOW.replace("a.py", "../lib/x.py"))
    (bench.project.parent / "lib").mkdir()
    (bench.project.parent / "lib/x.py").write_text("")
    error = refused(bench)
    assert f"its path ../lib/x.py leads out of {bench.project}" in error.message
    above = bench.project.parent
    assert error.hint == (
        f"use --working-directory {above}, and write the path from there: lib/x.py"
    )


def test_an_absolute_link_to_a_file_of_the_project(bench: Bench) -> None:
    (bench.project / "link").symlink_to(bench.project / "a.py")
    error = refused(bench)
    assert "an absolute path, which is outside of every release" in error.message
    assert "by a relative path" in error.hint


def test_options_that_are_not_given_again_are_named(bench: Bench) -> None:
    nodes = ("a:log_rate_limit=10/1s",)
    flags = {"nice": "3", "exit_when_nodes_finish": False, "nodes": nodes}
    first = bench.deploy(env=("KEY=secret",), **flags)  # type: ignore[arg-type]
    assert bench.store.manifest(first.release).given == {
        **{"dora": bench.dora, "env": ["KEY=secret"], "exit_when_nodes_finish": "no"},
        **{"nice": "3", "nodes": [*nodes]},
    }
    assert bench.warnings == []
    bench.write("dataflow.systemd.yml", "env: {KEY: other}\n")
    bench.deploy(nice="4")
    assert bench.warnings == [
        f"options of release {first.release} are not given any more: "
        "--no-exit-when-nodes-finish, --node a:log_rate_limit=10/1s; "
        "give them again, or write them to dataflow.systemd.yml, to keep them"
    ]
    bench.deploy(nice="4")
    assert bench.warnings == []
    (bench.project / "dataflow.systemd.yml").unlink()
    bench.deploy(nice="4", env=("KEY=secret",))
    bench.deploy(nice="4")
    assert [one.partition("any more: ")[2].partition(";")[0] for one in bench.warnings] == ["--env"]


def test_a_dataflow_of_another_user_is_not_replaced(bench: Bench) -> None:
    """By its unit file, its unit, or its last release."""
    first = bench.deploy()
    path = bench.manager.paths[1]
    text = path.read_text()
    path.write_text(text.replace("[Service]", "[Service]\nUser=alice"))
    lives, said = bench.manager.lives, "the dataflow of that name is alice's"
    assert said in refused(bench).message
    assert bench.manager.lives == lives
    path.unlink()
    bench.manager.units[UNIT] |= {"User": "alice"}
    assert said in refused(bench).message
    bench.manager.units.pop(UNIT)
    manifest = bench.store.manifest(first.release)
    bench.store.write_manifest(replace(manifest, user="alice"))
    error = refused(bench)
    assert (error.code, said in error.message) == (ExitCode.NAME_IN_USE, True)
    assert [*bench.releases] == [first.release]
