"""`start --push`: which machines are asked, and when nothing is copied."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from dora_systemd.decisions.machines.member import Member
from dora_systemd.decisions.machines.push import format_place
from dora_systemd.decisions.remote.hosts import Host, parse_host
from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.machines.push import place_problem, push
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
    bench.plan = replace(bench.plan, members=())
    with pytest.raises(DoraSystemdError, match="run on this machine") as caught:
        bench.push()
    assert caught.value.code is ExitCode.USAGE


def test_no_rsync_here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert place_problem(tmp_path, "") == (
        f"rsync is not installed on {os.uname().nodename}",
        "there: apt install rsync",
    )
