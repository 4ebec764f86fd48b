"""What root packs of another user's project for `deploy -H`."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.releases.parcel import Parcel
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.programs import Account, own_account
from dora_systemd.verbs.releases import send
from dora_systemd.verbs.start.request import StartRequest

FLOW = "nodes: [{id: a, path: a.py}]\n"
MODEST, IMMODEST = "restart_policy: always\n", "user: root\n"

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="gives files to somebody else")


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A project of another user."""
    root = tmp_path / "robot"
    root.mkdir()
    for name, text in (("robot.yml", FLOW), ("a.py", ""), ("robot.systemd.yml", MODEST)):
        (root / name).write_text(text)
        os.chown(root / name, 1, 1)
    os.chown(root, 1, 1)
    return root


def pack(
    project: Path, meanwhile: Callable[[], object] = bool, is_reader_root: bool = False
) -> dict[str, Any]:
    """Pack it. meanwhile: happens when the settings are checked, and not packed yet."""
    return dict(pack_whole(project, meanwhile, is_reader_root).files)


def pack_whole(
    project: Path,
    meanwhile: Callable[[], object] = bool,
    is_reader_root: bool = False,
    told: list[str] | None = None,
    senders: list[send.Sender] | None = None,
    **flags: object,
) -> Parcel:
    """As pack(). told: gets stages and warnings. senders: what a reader is found for."""
    request = StartRequest(str(project / "robot.yml"), flags=flags)
    tell = ([] if told is None else told).append

    def find_reader(sender: send.Sender) -> Account | None:
        meanwhile()
        if senders is not None:
            senders.append(sender)
        # The other user cannot reach the directory.
        return None if is_reader_root else own_account()

    with send.packed(request, tell, tell, find_reader) as found:
        return found.parcel


def test_a_project_of_another_user(project: Path) -> None:
    assert pack(project).keys() == {"robot.yml", "a.py", "robot.systemd.yml"}
    (project / "robot.systemd.yml").rename(project / "settings.yml")
    (project / "robot.systemd.yml").symlink_to("settings.yml")
    with pytest.raises(DoraSystemdError, match="symbolic link"):
        pack(project)


def test_settings_that_only_root_may_have(project: Path) -> None:
    (project / "robot.systemd.yml").write_text(IMMODEST)
    with pytest.raises(DoraSystemdError, match="the file is not root's") as caught:
        pack(project)
    assert caught.value.code is ExitCode.NO_PERMISSION


@pytest.mark.parametrize("first", [MODEST, None])
def test_settings_that_change_after_the_check(project: Path, first: str | None) -> None:
    """Over there they would be root's."""
    beside = project / "robot.systemd.yml"
    if first is None:
        beside.unlink()
    with pytest.raises(DoraSystemdError, match="changed while it was packed") as caught:
        pack(project, lambda: beside.write_text(IMMODEST))
    assert (caught.value.hint, caught.value.code) == ("deploy again", ExitCode.BAD_INPUT)


def test_settings_that_are_hidden_after_the_check(project: Path) -> None:
    beside = project / "robot.systemd.yml"
    with pytest.raises(DoraSystemdError, match="changed while it was packed"):
        pack(project, beside.unlink)


def test_settings_behind_a_link_of_roots(project: Path) -> None:
    for path in (project, *project.iterdir()):
        os.chown(path, 0, 0)
    (project / "robot.systemd.yml").rename(project / "settings.yml")
    (project / "robot.systemd.yml").symlink_to("settings.yml")
    assert pack(project)["robot.systemd.yml"].target == "settings.yml"


@pytest.mark.parametrize("file", ["/root/secret.env", "../secret.env"])
def test_files_that_only_root_could_read_over_there(project: Path, file: str) -> None:
    """Here they would be read as the owner of the settings."""
    beside = project / "robot.systemd.yml"
    beside.write_text(f"env_file: {file}\n")
    with pytest.raises(DoraSystemdError, match="env_file is not in the project") as caught:
        pack(project)
    assert caught.value.code is ExitCode.NO_PERMISSION
    (project / "own.env").write_text("A=1\n")
    beside.write_text("env_file: own.env\n")
    assert "own.env" in pack(project)


def test_what_root_does_not_read_where_no_other_user_can(project: Path) -> None:
    """Whoever can replace a file could have root send any file of this machine."""
    for path in (project, *project.iterdir()):
        os.chown(path, 0, 0)
    assert pack(project, is_reader_root=True).keys() >= {"robot.yml"}
    (project / "lib").mkdir()
    (project / "lib/b.py").touch()
    os.chown(project / "lib", 1, 1)
    with pytest.raises(DoraSystemdError) as caught:
        pack(project, is_reader_root=True)
    error = caught.value
    assert error.message == f"cannot read {project}/lib as root: others can change it"
    assert error.hint == "let its owner deploy it, or make the user dora, who reads it"
    assert error.code is ExitCode.BAD_INPUT


def test_a_path_of_this_machine_is_not_sent(project: Path) -> None:
    (project / "robot.yml").write_text(FLOW.replace("a.py", f"{project}/a.py"))
    with pytest.raises(DoraSystemdError) as caught:
        pack(project)
    error = caught.value
    path = f"{project}/a.py"
    assert error.message == f"cannot send node a: its path {path} is of this machine"
    assert (error.hint, error.code) == (f"write it relative to {project}", ExitCode.BAD_INPUT)


def test_what_a_parcel_says(project: Path) -> None:
    """The other host knows nothing else of the project."""
    told: list[str] = []
    parcel = pack_whole(project, told=told)
    facts = ("robot", str(project), "robot.yml", None, "")
    assert parcel == Parcel(*facts, parcel.files, owner="daemon")
    size = sum(one.size for one in parcel.files.values())
    assert told[0] == f"packing: 0B of {size}B"
    assert told[-1] == f"packing: {size}B of {size}B"
    for path in (project, *project.iterdir()):
        os.chown(path, 0, 0)
    above = pack_whole(project, working_directory=str(project))
    assert (above.directory, above.owner) == (".", "")


def test_a_virtual_environment_stays_where_it_is(project: Path) -> None:
    (project / ".venv/bin").mkdir(parents=True)
    (project / ".venv/bin/python").symlink_to("/usr/bin/python3")
    told: list[str] = []
    pack_whole(project, told=told)
    assert told[0] == (
        f"{project}/.venv stays here: name a virtual environment of the hosts with --venv"
    )
    told.clear()
    pack_whole(project, told=told, venv="/opt/venv")
    assert all(one.startswith("packing: ") for one in told)


def test_who_reads_a_project(project: Path) -> None:
    """Its owner, so that root need not: git runs what a repository of that user says."""
    senders: list[send.Sender] = []
    pack_whole(project, senders=senders)
    reader = send._reader(senders[0])
    assert reader is not None
    assert (reader.uid, send._owners(reader), send._owners(None)) == (1, [0, 1], [])
