"""The machines of a config.yml, without ssh."""

import json
from pathlib import Path

import pytest

from dora_systemd import __version__
from dora_systemd.decisions.machines.description import Facts, parse_facts, problems, required
from dora_systemd.decisions.machines.link_command import LinkOptions, ssh_link_arguments
from dora_systemd.decisions.machines.member import with_machine, without_machine
from dora_systemd.decisions.machines.wire import Forwards
from dora_systemd.decisions.remote.hosts import parse_host
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.machines.register import (
    add_machine,
    authorized_line,
    chosen,
    forced_words,
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


PUBLIC = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5 dora-systemd gpu"
MARK = f"doralink-{'0' * 32}"


def test_a_key_can_do_nothing_else() -> None:
    line = authorized_line("/usr/bin/doractl", PUBLIC, "dora-systemd:gpu")
    assert line.startswith("restrict,port-forwarding,permitlisten=")
    assert 'permitopen="127.0.0.1:61000"' in line
    assert "*" not in line, "that would be each service of the machine"
    assert 'command="/usr/bin/doractl member" ssh-ed25519 AAAAC3NzaC1lZDI1NTE5 dora' in line


@pytest.mark.parametrize("program", ["doractl", '/a"b', "/a b", "/a\nb", ""])
def test_a_program_that_cannot_be_forced(program: str) -> None:
    with pytest.raises(DoraSystemdError):
        authorized_line(program, PUBLIC, "x")


def test_what_a_link_asks_for_passes() -> None:
    words = ("member", "/srv/it's/robot.yml", "--name=robot", "--env=A=1 2")
    link = LinkOptions("/run/x", "gpu", "gpu", words)
    arguments = ssh_link_arguments(link, Forwards(61001, {"head": 61002, "gpu": 61003}), MARK)
    assert forced_words(arguments[-1]) == (MARK, ["--as=gpu", *words[1:]])


@pytest.mark.parametrize(
    "original",
    [
        "",
        "id",
        "doractl member",
        "exec sh -c x doractl mark member",
        f"exec sh -c x doractl {MARK} stop --all",
        f"exec sh -c x doractl {MARK}",
        "'",
    ],
)
def test_what_else_somebody_asks_for(original: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        forced_words(original)
    assert caught.value.code is ExitCode.USAGE


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("", 'machines:\n  gpu: {host: "b"}\n'),
        ("sandbox: strict", 'sandbox: strict\nmachines:\n  gpu: {host: "b"}\n'),
        (
            "machines:  # ours\n    arm: {host: c}\n# more\nb: 2\n",
            'machines:  # ours\n    gpu: {host: "b"}\n    arm: {host: c}\n# more\nb: 2\n',
        ),
        ("machines:", 'machines:\n  gpu: {host: "b"}\n'),
        ("machines: {arm: {host: c}}\n", None),
    ],
)
def test_one_more_machine(before: str, after: str | None) -> None:
    assert with_machine(before, "gpu", "b") == after


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("machines:\n  gpu: {host: b}\n  arm: {host: c}\n", "machines:\n  arm: {host: c}\n"),
        ("machines:\n  gpu:\n    host: b\n    venv: /x\n  arm: {}\n", "machines:\n  arm: {}\n"),
        ("a: 1\nmachines:\n  gpu: {host: b}\nb: 2\n", "a: 1\nb: 2\n"),
        ("machines: {gpu: {host: b}}\n", None),
        ("machines:\n  arm: {}\n", None),
    ],
)
def test_one_machine_less(before: str, after: str | None) -> None:
    assert without_machine(before, "gpu") == after


HERE = Facts("0.1.0", "1.1.0", "/usr/bin/doractl", "root", True, 5)


def test_facts() -> None:
    assert parse_facts(f"welcome\n{HERE.to_json()}\n") == HERE
    for text in ("", "welcome", "{}", "[" * 100_000):
        with pytest.raises(DoraSystemdError):
            parse_facts(text)


def test_problems_of_a_machine() -> None:
    assert list(problems(HERE, HERE, 0)) == []
    there = Facts("0.2.0", "", "/usr/bin/doractl", "alice", False, 5)
    found = [reason for reason, _ in problems(HERE, there, -2_000_000)]
    assert found == [
        "it has dora-systemd 0.2.0, this machine 0.1.0",
        "it has no dora",
        "alice does not linger, so it would end with the session",
        "its clock differs by 2.0 s",
    ]
    with pytest.raises(DoraSystemdError) as caught:
        required(problems(HERE, there, 0), "gpu")
    assert caught.value.code is ExitCode.BAD_INPUT
