"""What the shells are told at the Tab key, as far as no systemd is needed for it."""

import os
import re
import shlex
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import click
import pytest

from dora_systemd.cli import main
from dora_systemd.cli.completion import TYPES, VARIABLE
from dora_systemd.cli.group import HIDDEN, VERBS, doractl
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.releases.listing import store_of
from tests.unit.checkout import CHECKOUT
from tests.unit.fakes.journal import FakeJournal
from tests.unit.fakes.library import FakeSystemd, fake_systemd
from tests.unit.fakes.manager import UUID, FakeManager, options
from tests.unit.fakes.programs import make_program
from tests.unit.tools import require

SCRIPTS = {"bash": "doractl", "zsh": "_doractl", "fish": "doractl.fish"}

Complete = Callable[..., list[str]]


@pytest.fixture
def complete(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Complete:
    def ask(words: str, shell: str = "bash") -> list[str]:
        monkeypatch.setenv(VARIABLE, f"{shell}_complete")
        monkeypatch.setenv("COMP_WORDS", words)
        monkeypatch.setenv("COMP_CWORD", str(len(words.split(" ")) - 1))
        main.run([])
        out, err = capsys.readouterr()
        assert err == ""
        return list(filter(None, out.split("\n")))

    return ask


@pytest.fixture
def systemd(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeSystemd:
    """One with three dataflows."""
    FakeJournal(monkeypatch, tmp_path)
    manager = FakeManager()
    for number, name in enumerate(("robot", "rover", "vision")):
        manager.add(options(name, UUID[:-1] + str(number)))
    return fake_systemd(monkeypatch, manager)


def test_verbs(complete: Complete) -> None:
    assert complete("doractl ") == [f"plain,{name}" for name in VERBS if name not in HIDDEN]
    assert complete("doractl st", "zsh") == [
        *("plain", "start", VERBS["start"].summary),
        *("plain", "stop", VERBS["stop"].summary),
    ]
    assert complete("doractl help sto") == ["plain,stop"]
    assert complete("doractl node ") == ["plain,restart", "plain,stop"]


@pytest.mark.usefixtures("systemd")
@pytest.mark.parametrize("verb", ["stop", "show", "list", "ps", "node restart", "stop --user"])
def test_dataflows(verb: str, complete: Complete) -> None:
    assert complete(f"doractl {verb} ro") == ["plain,robot", "plain,rover"]


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        ("doractl --us", ["plain,--user"]),
        ("doractl logs --le", ["plain,--level"]),
        ("doractl logs --level w", ["plain,warn"]),
        ("doractl list -o j", ["plain,json"]),
        ("doractl start data", ["file,data"]),
        ("doractl start --venv .v", ["dir,.v"]),
        ("doractl start --uid roo", ["plain,root"]),
        ("doractl start --restart-policy on", ["plain,on-failure"]),
        ("doractl run --replace sta", ["plain,start-first"]),
        ("doractl run --device /dev/v", ["file,/dev/v"]),
        ("doractl nonsense x", []),
        ("doractl logs --nonsense", []),
    ],
)
def test_words(words: str, answer: list[str], complete: Complete) -> None:
    assert complete(words) == answer


def test_hosts(complete: Complete, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    hosts = tmp_path / "dora-systemd/hosts"
    hosts.parent.mkdir()
    hosts.write_text("base\nalice@arm\n")
    assert complete("doractl -H ") == ["plain,all", "plain,base", "plain,alice@arm"]
    assert complete("doractl list --host base,a") == ["plain,base,all", "plain,base,alice@arm"]
    hosts.write_text("-oX\n")
    assert complete("doractl -H ") == []


def test_dataflows_of_this_machine_are_not_there(
    complete: Complete, systemd: FakeSystemd, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    release = "20261121T220012"
    store_of(Scope(True, os.getuid()), "x").release(release).mkdir(parents=True)
    assert complete("doractl rollback --user x ") == [f"plain,{release}"]
    lines = ("-H base stop ", "stop -H base ", "logs --host=base --node ")
    for words in (*lines, "-H base rollback --user x "):
        assert complete(f"doractl {words}") == []
    assert not systemd.timeouts, "nobody has asked it"


@pytest.mark.usefixtures("systemd")
def test_start_takes_a_file_or_what_has_ended(complete: Complete) -> None:
    assert complete("doractl start rob") == ["plain,robot", "file,rob"]
    assert complete("doractl start ") == ["file,"]
    assert complete("doractl run ro") == ["file,ro"]


def test_what_cannot_be_found_out_is_no_error(complete: Complete, systemd: FakeSystemd) -> None:
    systemd.refuses = DoraSystemdError("cannot reach systemd")
    assert complete("doractl show ") == []


def test_the_table_has_no_parameter_that_is_gone() -> None:
    commands = [doractl.get_command(click.Context(doractl), name) for name in VERBS]
    members = [one for command in commands for one in getattr(command, "commands", {}).values()]
    names = {param.name for command in (*commands, *members) if command for param in command.params}
    assert TYPES.keys() <= names


@pytest.mark.parametrize("shell", SCRIPTS)
def test_scripts_are_readable_for_their_shells(shell: str) -> None:
    script = CHECKOUT / "packaging/completions" / SCRIPTS[shell]
    assert f"{VARIABLE}" in script.read_text()
    assert f"{shell}_complete" in script.read_text()
    require(shell)
    done = subprocess.run([shell, "-n", str(script)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


BASH = """
source {script}
compopt() {{ COMPREPLY+=("$*"); }}
COMP_LINE={line}; COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
_doractl
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


def ask_bash(place: Path, line: str, words: Sequence[str], answer: str) -> list[str]:
    """What the script offers. words: as bash gives them. answer: prints that of doractl."""
    make_program(place / "doractl", answer)
    given = {"line": shlex.quote(line), "words": shlex.join(words)}
    script = BASH.format(script=CHECKOUT / "packaging/completions/doractl", **given)
    done = subprocess.run(
        ["bash", "-c", script],
        env={"PATH": f"{place}:/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.splitlines()


def test_bash_takes_the_answer(tmp_path: Path) -> None:
    """A value is one word, whatever characters are in it."""
    answer = 'echo "plain,$COMP_WORDS|$COMP_CWORD"\necho "plain,a b"'
    words = ["doractl", "stop", "ro"]
    offered = ask_bash(tmp_path, "doractl  stop ro", words, answer)
    assert offered == ["doractl stop ro|2", "a b"]


@pytest.mark.parametrize(
    ("line", "value", "offered"),
    [
        ("doractl logs --level = w", "warn", "warn"),
        ("doractl logs --level =", "warn", "warn"),
        ("doractl -H box : 22", "box:2222", "2222"),
        ("doractl -H box :", "box:2222", "2222"),
        ("doractl -H alice @ ar", "alice@arm", "@arm"),
        ("doractl -H alice @", "alice@arm", "@arm"),
        ("doractl --host = base,alice @ ar", "base,alice@arm", "@arm"),
        ("doractl -H 'alice@ar", "alice@arm", "alice@arm"),
    ],
)
def test_bash_cuts_words(tmp_path: Path, line: str, value: str, offered: str) -> None:
    """At = : and @; what bash replaces begins behind = and :, and with @."""
    whole = re.sub(" ([=:@]) ?", r"\1", line)
    answer = f'echo "plain,{value}"; echo "plain,$COMP_WORDS|$COMP_CWORD"'
    last = f"{whole}|{whole.count(' ')}"
    assert ask_bash(tmp_path, whole, line.split(), answer) == [offered, last]


@pytest.mark.parametrize("line", ["doractl list > fi", "doractl list 2> fi", "doractl list <"])
def test_bash_completes_a_file_behind_a_redirection(tmp_path: Path, line: str) -> None:
    words = line.replace("2>", "2 >").split()
    words += [""] * line.endswith("<")
    assert ask_bash(tmp_path, line, words, "echo plain,robot") == ["-o default"]
    quoted = ["doractl", "logs", "--grep", "'<x>'", "ro"]
    assert ask_bash(tmp_path, " ".join(quoted), quoted, "echo plain,robot") == ["robot"]
