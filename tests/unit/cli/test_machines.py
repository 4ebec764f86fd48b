"""`doractl logs` of several machines: which ones, and with which options."""

import os
from pathlib import Path

import pytest

from dora_systemd.cli.group import doractl
from dora_systemd.cli.remote import machines
from dora_systemd.cli.remote.plan import Plan
from dora_systemd.cli.remote.run import run_on_all
from dora_systemd.cli.verbs.look.logs import command
from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import LINK_PREFIX
from dora_systemd.scope import scope_of
from dora_systemd.verbs.logs import has_unit, unit_places
from dora_systemd.verbs.remote.talk import ANSWER_SECONDS
from tests.unit.fakes.library import fake_systemd
from tests.unit.fakes.manager import FakeManager, ScopeIn, options
from tests.unit.fakes.programs import make_program
from tests.unit.verbs.facts.test_machines import WORDS

PLACED = (Placed("yolo", "gpu"),)
GPU = Host("gpu", "alice@gpu-box", "2222")
HEAD = Host("head", "")


@pytest.fixture(autouse=True)
def systemd(monkeypatch: pytest.MonkeyPatch) -> None:
    """One with a dataflow on two machines, and with another one."""
    manager = FakeManager()
    manager.add(options("robot", placed=PLACED))
    manager.add(options("alone", "660e8400-e29b-41d4-a716-446655440000"))
    manager.units["doralink-robot:gpu.service"] = {"ExecStart": [[WORDS[0], WORDS, False]]}
    fake_systemd(monkeypatch, manager)


def found(*words: str) -> tuple[list[Host], Plan] | None:
    with command.make_context("logs", list(words), **doractl.context_settings) as context:
        return machines.find_machines(scope_of(None), context)


def test_all_machines() -> None:
    asked = found("robot", "-n", "5", "--follow", "--since=1h", "-o", "json", "-b")
    assert asked
    hosts, plan = asked
    assert hosts == [HEAD, GPU]
    assert plan.words == [
        *("logs", "robot", "--follow", "--tail=5", "--boot=0", "--since=1h", "--machine=head"),
    ]
    assert (plan.key, plan.is_endless, plan.options["output"]) == ("machine", True, "json")


@pytest.mark.parametrize(
    ("words", "hosts"),
    [
        (("--machine", "gpu"), [GPU]),
        (("--node", "yolo"), [GPU]),
        (("--node", "y*"), [HEAD, GPU]),
        (("--node", "yolo", "--node", "camera"), [HEAD, GPU]),
    ],
)
def test_some_machines(words: tuple[str, ...], hosts: list[Host]) -> None:
    asked = found("robot", *words)
    assert asked and asked[0] == hosts


@pytest.mark.parametrize(
    "words",
    [
        ("robot", "--machine", "head"),
        ("robot", "--node", "camera"),
        ("alone",),
        ("nothing",),
        ("rob*",),
    ],
)
def test_this_machine_only(words: tuple[str, ...]) -> None:
    assert found(*words) is None


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("robot", "--machine", "gpx"), ExitCode.USAGE),
        (("alone", "--machine", "gpu"), ExitCode.USAGE),
        (("robot", "alone", "--machine", "gpu"), ExitCode.USAGE),
        (("--machine", "gpu"), ExitCode.USAGE),
        (("nothing", "--machine", "gpu"), ExitCode.NOT_FOUND),
    ],
)
def test_wrong_machines(words: tuple[str, ...], code: ExitCode) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        found(*words)
    assert caught.value.code is code


def test_hint_for_one_machine() -> None:
    """No verb shows machines of a dataflow that has only this one."""
    with pytest.raises(DoraSystemdError) as caught:
        found("alone", "--machine", "gpu")
    assert caught.value.hint == "leave out --machine"


HERE = """printf '__REALTIME_TIMESTAMP=1\\nSYSLOG_IDENTIFIER=robot/cam\\nMESSAGE=here\\n\\n'"""
LOGIN = 'for command; do :; done\nHOST=gpu; export HOST; exec sh -c "$command"'


class Hasty(Plan):
    """A plan whose bound is shorter."""

    @property
    def silence(self) -> float | None:
        return super().silence and 0.5


def test_a_member_that_says_nothing_holds_up_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It has logged in: the lines of the head are printed, and the member is named."""
    make_program(tmp_path / "ssh", LOGIN)
    make_program(tmp_path / "doractl", f'[ "$HOST" = gpu ] && exec sleep 1000\n{HERE}')
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    asked = found("robot")
    assert asked
    hosts, plan = asked
    assert plan.silence == ANSWER_SECONDS
    assert run_on_all(hosts, Hasty(*plan)) == ExitCode.NO_HOST
    out, err = capsys.readouterr()
    assert "here" in out
    assert err.startswith("doractl: cannot reach gpu: no answer within 0.5s\n")


def test_another_scope_is_not_merged(capsys: pytest.CaptureFixture[str]) -> None:
    other = scope_of(os.getuid() == 0)
    with command.make_context("logs", ["robot"], **doractl.context_settings) as context:
        assert machines.print_machines(other, context) is None
    assert "the logs of gpu are left out" in capsys.readouterr().err


@pytest.mark.parametrize("place", ["run/systemd/transient", "home/.config/systemd/user"])
def test_links_are_seen_without_a_question(tmp_path: Path, place: str) -> None:
    scope = ScopeIn(is_user=True, uid=1, root=tmp_path / "run")
    environment = {"HOME": str(tmp_path / "home")}

    def are_seen() -> bool:
        return has_unit(unit_places(scope, environment), LINK_PREFIX)

    assert not are_seen()
    (tmp_path / place).mkdir(parents=True)
    (tmp_path / place / "dora-robot.service").touch()
    assert not are_seen()
    (tmp_path / place / "doralink-robot:gpu.service").touch()
    assert are_seen()
