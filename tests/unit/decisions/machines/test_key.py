import pytest

from dora_systemd.decisions.machines.description import Facts, parse_facts, problems, required
from dora_systemd.decisions.machines.entry import with_machine, without_machine
from dora_systemd.decisions.machines.key import authorized_line, forced_words
from dora_systemd.decisions.machines.link_command import LinkOptions, ssh_link_arguments
from dora_systemd.decisions.machines.wire import Forwards
from dora_systemd.errors import DoraSystemdError, ExitCode

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
