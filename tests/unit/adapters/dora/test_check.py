"""Dora's own checks, with a dora that is a script and counts what it is asked."""

import os
from pathlib import Path

import pytest

from dora_systemd.adapters.dora.check import DoraCheck
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.errors import DoraSystemdError, ExitCode
from tests.unit.fakes.programs import make_dora


@pytest.fixture
def options(tmp_path: Path) -> RunnerOptions:
    flow = tmp_path / "d.yml"
    flow.write_text("nodes: []")
    dora = make_dora(tmp_path / "dora", "0.4.1")
    return RunnerOptions("robot", "uuid", str(flow), str(tmp_path), dora)


def asked(options: RunnerOptions) -> set[str]:
    return set(Path(f"{options.dora}.asked").read_text().split())


def test_a_coordinator_that_listens_proves_the_version(options: RunnerOptions) -> None:
    check = DoraCheck(options, os.environ, lambda: True)
    assert check.beside(lambda: 7) == 7
    assert asked(options) == {"validate"}


def test_without_a_coordinator_the_version_is_asked_for(options: RunnerOptions) -> None:
    for check in (DoraCheck(options, os.environ), DoraCheck(options, os.environ, lambda: False)):
        with pytest.raises(DoraSystemdError, match=r"it is dora 0\.4\.1") as caught:
            check.result()
        assert caught.value.code is ExitCode.NO_DORA


def test_a_member_leaves_to_the_head_what_is_the_same_there(options: RunnerOptions) -> None:
    check = DoraCheck(options._replace(machine="gpu"), os.environ, lambda: True)
    assert check.beside(lambda: 7) == 7
    assert not Path(f"{options.dora}.asked").exists()


def test_a_variable_that_is_not_set_is_named(options: RunnerOptions) -> None:
    """It may be set where somebody runs dora validate."""
    text = "data did not match any variant of untagged enum EnvValue at line 1"
    script = f'#!/bin/sh\necho "[ERROR]" >&2\necho "{text}" >&2\nexit 1\n'
    Path(options.dora).write_text(script)
    Path(options.dataflow).write_text("nodes: [{id: a, path: a.py, env: {A: '${LIB}/$PWD'}}]")
    check = DoraCheck(options, {"PWD": "/srv", "PATH": os.environ["PATH"]}, lambda: True)
    with pytest.raises(
        DoraSystemdError, match=r"a variable that is not set: LIB at line 1"
    ) as caught:
        check.result()
    assert caught.value.hint.startswith("set the variable by --env")


def test_what_we_refuse_comes_before_what_dora_refuses(options: RunnerOptions) -> None:
    """doractl says the same of the same file before a start."""

    def prepare() -> None:
        raise DoraSystemdError("ours")

    Path(options.dataflow).write_text("refused")
    check = DoraCheck(options, os.environ, lambda: True)
    with pytest.raises(DoraSystemdError, match="ours"):
        check.beside(prepare)
    with pytest.raises(DoraSystemdError, match="it is refused"):
        check.beside(lambda: 7)


def test_without_dora_nothing_else_matters(options: RunnerOptions) -> None:
    def prepare() -> None:
        raise DoraSystemdError("ours")

    check = DoraCheck(options, os.environ, lambda: False)
    with pytest.raises(DoraSystemdError, match=r"it is dora 0\.4\.1"):
        check.beside(prepare)
