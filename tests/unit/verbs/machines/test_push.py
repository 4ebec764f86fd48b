"""`start --push`: which machines are asked, and when nothing is copied."""

import os
from collections.abc import Sequence
from pathlib import Path

import pytest

from dora_systemd.decisions.machines.member import Member
from dora_systemd.decisions.remote.hosts import Host, parse_host
from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.machines.push import (
    check_copied,
    check_place,
    format_place,
    place_problem,
    place_words,
    push,
    rsync_command,
)
from dora_systemd.verbs.start.plan import Plan
from tests.unit.fakes.manager import ScopeIn, options
from tests.unit.fakes.programs import make_program


class Bench:
    """What a push does, in its order. answers: by host."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        self.log = tmp_path / "done"
        self.log.touch()
        self.answers: dict[str, str] = {}
        copy = f'for one; do last=$one; done; echo "copy $last" >> {self.log}'
        make_program(tmp_path / "bin/rsync", copy)
        monkeypatch.setenv("PATH", f"{tmp_path}/bin:/bin")
        members = [Member(one, parse_host(one), ("member", "/srv/r/f.yml")) for one in ("b", "c")]
        scope, settings = ScopeIn(True, 1000, tmp_path), resolve_settings({}, {}, [])
        self.plan = Plan(scope, options(), settings, None, {}, members=tuple(members))

    def _ask(self, host: Host, words: Sequence[str]) -> str:
        with self.log.open("a") as log:
            log.write(f"ask {host.text} {words[1]}\n")
        return self.answers.get(host.text, format_place("", ""))

    @property
    def done(self) -> list[str]:
        return self.log.read_text().splitlines()

    def push(self) -> None:
        push(self.plan, lambda _: None, self._ask)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Bench:
    return Bench(monkeypatch, tmp_path)


def test_all_are_asked_before_anything_is_copied(bench: Bench) -> None:
    bench.push()
    assert bench.done == [
        *("ask b --place=/srv/r", "ask c --place=/srv/r"),
        *("copy b:/srv/r/", "copy c:/srv/r/"),
    ]


def test_one_machine_that_takes_nothing_is_enough(bench: Bench) -> None:
    bench.answers["c"] = format_place("/srv/r belongs to bob", "")
    with pytest.raises(DoraSystemdError, match="machine c: /srv/r belongs to bob"):
        bench.push()
    assert not [one for one in bench.done if one.startswith("copy")]


def test_what_is_wrong_here_comes_first(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(DoraSystemdError, match=r"^cannot copy /srv: rsync is not inst") as caught:
        bench.push()
    assert caught.value.code is ExitCode.BAD_INPUT
    assert not bench.done


def test_one_machine_has_nothing_to_copy(bench: Bench) -> None:
    bench.plan = bench.plan._replace(members=())
    with pytest.raises(DoraSystemdError, match="run on this machine") as caught:
        bench.push()
    assert caught.value.code is ExitCode.USAGE


def test_no_rsync_here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert place_problem(tmp_path, "") == (
        f"rsync is not installed on {os.uname().nodename}",
        "there: apt install rsync",
    )


FILE = "/srv/my robot/flow.yml"


def member(host: str = "alice@gpu-box", file: str = "/home/alice/robot/flow.yml") -> Member:
    return Member("gpu", parse_host(host), ("member", file, "--name=robot"))


def test_the_directory_of_the_file_is_copied() -> None:
    words = rsync_command(member(), FILE)
    assert words[0] == "rsync"
    assert words[-3:] == ["--", "/srv/my robot/", "alice@gpu-box:/home/alice/robot/"]
    assert "--exclude=.git/" in words
    assert "--exclude=/flow.systemd.yml" in words, "the settings are those of the head"
    assert not {"--delete", "--owner", "--archive", "--devices"} & {*words}
    assert place_words(member()) == ("member", "--place=/home/alice/robot")


@pytest.mark.parametrize(
    ("host", "target", "port"),
    [
        ("gpu-box:2222", "gpu-box:", " -p2222"),
        ("alice@fd00::2", "alice@[fd00::2]:", ""),
        ("[fd00::2]:2222", "[fd00::2]:", " -p2222"),
    ],
)
def test_hosts_as_rsync_takes_them(host: str, target: str, port: str) -> None:
    words = rsync_command(member(host), FILE)
    assert words[-1] == f"{target}/home/alice/robot/"
    (shell,) = (one for one in words if one.startswith("--rsh="))
    assert shell.endswith(port) or not port
    assert "-oBatchMode=yes" in shell


def test_what_the_machine_says_of_its_directory() -> None:
    check_place(member(), format_place("", ""))
    with pytest.raises(DoraSystemdError) as caught:
        check_place(member(), format_place("/srv/x belongs to bob", "ask bob"))
    assert caught.value.code is ExitCode.BAD_INPUT
    assert caught.value.message == (
        "cannot copy the dataflow to machine gpu: /srv/x belongs to bob"
    )
    assert caught.value.hint == "ask bob"


@pytest.mark.parametrize("answer", ["", "{}", "[]", '{"problem": 1}', "[" * 100_000])
def test_an_answer_of_something_else(answer: str) -> None:
    with pytest.raises(DoraSystemdError, match="its answer cannot be read"):
        check_place(member(), answer)


def test_why_rsync_has_failed() -> None:
    check_copied(member(), 0, "")
    said = "rsync: [Receiver] mkdir failed: Permission denied (13)\nrsync error: some files (23)\n"
    with pytest.raises(DoraSystemdError, match="mkdir failed: Permission denied"):
        check_copied(member(), 11, said)
    with pytest.raises(DoraSystemdError, match="exit status 12"):
        check_copied(member(), 12, "")
    with pytest.raises(DoraSystemdError) as caught:
        check_copied(member(), 255, "ssh: connect to host gpu-box port 22: Connection refused\n")
    assert caught.value.code is ExitCode.NO_HOST
