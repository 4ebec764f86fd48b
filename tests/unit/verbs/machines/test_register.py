"""The machines of a config.yml, without ssh."""

import json
from pathlib import Path

import pytest

from dora_systemd import __version__
from dora_systemd.decisions.remote.hosts import parse_host
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.machines.register import (
    add_machine,
    chosen,
    known_machines,
    remove_machine,
)
from tests.unit.fakes.programs import make_dora, make_program
from tests.unit.fakes.ssh import fake_ssh

USER = Scope(True, 1000)
GPU = parse_host("alice@gpu-box")


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home whose machines all answer."""
    facts = {"program": "/usr/bin/doractl", "user": "alice", "linger": True, "now": 0}
    said = json.dumps({"doractl": __version__, "dora": "1.1.0", **facts})
    fake_ssh(monkeypatch, tmp_path, f"echo '{said}' | sed \"s/: 0}}/: $(date +%s%6N)}}/\"")
    make_dora(tmp_path / "bin/dora", "1.1.0")
    monkeypatch.delenv("VIRTUAL_ENV", raising=False)
    monkeypatch.setattr("dora_systemd.verbs.start.read.SYSTEM_FILE", tmp_path / "none")
    return tmp_path


def environment(home: Path) -> dict[str, str]:
    return {"HOME": str(home)}


def test_there_and_back(home: Path) -> None:
    file = home / ".config/dora-systemd/config.yml"
    file.parent.mkdir(parents=True)
    file.write_text("# mine\ngrace_duration: 3s\n")
    file.chmod(0o600)
    let_in = home / "there/.ssh/authorized_keys"
    *_, last = add_machine(USER, environment(home), GPU, "gpu")
    assert "/usr/bin/doractl" in let_in.read_text()
    assert last == f"Machine added: gpu (alice@gpu-box), in {file}"
    (known,) = known_machines(USER, environment(home))
    assert (known.name, known.host, Path(known.key).parent.name) == ("gpu", GPU, "ssh")
    assert file.stat().st_mode & 0o777 == 0o600
    assert file.read_text().startswith("# mine\n")
    *_, last = remove_machine(USER, environment(home), known)
    assert last == "Machine removed: gpu (alice@gpu-box)"
    assert file.read_text() == "# mine\ngrace_duration: 3s\n"
    assert list((file.parent / "ssh").iterdir()) == []
    assert let_in.read_text() == ""


def test_a_damaged_key_can_be_removed(home: Path) -> None:
    list(add_machine(USER, environment(home), GPU, "gpu"))
    (known,) = known_machines(USER, environment(home))
    public = Path(f"{known.key}.pub")
    public.write_text("")
    with pytest.raises(DoraSystemdError, match="cannot read the public key"):
        list(remove_machine(USER, environment(home), known))
    note, last = remove_machine(USER, environment(home), known, is_forced=True)
    assert "the line that ends in dora-systemd:gpu" in note
    assert last.startswith("Machine removed")
    assert not public.exists()


def test_a_machine_that_is_away_is_not_removed(home: Path, tmp_path: Path) -> None:
    """Else its key would be let in there for ever, and nobody here would know which one."""
    list(add_machine(USER, environment(home), GPU, "gpu"))
    (known,) = known_machines(USER, environment(home))
    make_program(tmp_path / "bin/ssh", "echo 'No route to host' >&2; exit 255")
    with pytest.raises(DoraSystemdError) as caught:
        list(remove_machine(USER, environment(home), known))
    assert caught.value.code is ExitCode.NO_HOST
    assert "--force" in caught.value.hint
    assert known_machines(USER, environment(home)) == [known]
    assert Path(known.key).exists()
    note, _ = remove_machine(USER, environment(home), known, is_forced=True)
    assert note.startswith("~/.ssh/authorized_keys of alice@gpu-box still has its key")
    assert not Path(known.key).exists()


@pytest.mark.parametrize(
    ("text", "name", "code"),
    [
        ("machines:\n  gpu: {host: b}\n", "gpu", ExitCode.NAME_IN_USE),
        ("machines: {arm: {host: c}}\n", "gpu", ExitCode.BAD_INPUT),
        ("", "head", ExitCode.USAGE),
    ],
)
def test_nothing_changes_then(home: Path, text: str, name: str, code: ExitCode) -> None:
    file = home / ".config/dora-systemd/config.yml"
    file.parent.mkdir(parents=True)
    file.write_text(text)
    with pytest.raises(DoraSystemdError) as caught:
        list(add_machine(USER, environment(home), GPU, name))
    assert caught.value.code is code
    assert file.read_text() == text
    assert not (file.parent / "ssh").exists()


def test_machines_by_name(home: Path) -> None:
    list(add_machine(USER, environment(home), GPU, "gpu"))
    known = known_machines(USER, environment(home))
    assert chosen(known, ()) == chosen(known, ("gpu",)) == known
    with pytest.raises(DoraSystemdError) as caught:
        chosen(known, ("arm",))
    assert caught.value.code is ExitCode.NOT_FOUND
