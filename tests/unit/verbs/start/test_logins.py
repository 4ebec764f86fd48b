"""Who is said to be able to reach the ports of a dataflow, and when."""

import pwd
from pathlib import Path

import pytest

from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.scope import Scope
from dora_systemd.verbs.start.logins import (
    has_run_here,
    judge_logins,
    login_users,
    start_notes,
)
from dora_systemd.verbs.start.plan import Plan
from tests.unit.fakes.manager import ScopeIn, options

PASSWD = """root:x:0:0:root:/root:/bin/bash
dora:x:990:990::/:/usr/sbin/nologin
nobody:x:65534:65534::/:/bin/sh
alice:x:1000:1000:Alice:/home/alice:/bin/bash
ftp:x:1001:1001::/srv/ftp:/usr/sbin/nologin
bob:x:1002:1002::/home/bob:
odd:x:a:1
"""
SYSTEM, USER = Scope(is_user=False, uid=0), Scope(is_user=True, uid=1000)


def plan(user: str | None, scope: Scope = SYSTEM, **flags: object) -> Plan:
    entry = user and pwd.struct_passwd((user, "x", 1, 1, "", "/", ""))
    return Plan(scope, options(), resolve_settings(flags, {}, []), entry or None, {})


@pytest.fixture
def passwd(tmp_path: Path) -> Path:
    path = tmp_path / "passwd"
    path.write_text(PASSWD)
    return path


def test_people_with_a_shell() -> None:
    assert login_users(PASSWD) == ["alice", "bob"]


def test_the_others_are_named(passwd: Path) -> None:
    (note,) = start_notes(plan("dora"), passwd)
    assert note.startswith("alice, bob can log in and")
    (note,) = start_notes(plan("alice"), passwd)
    assert note.startswith("bob can log in and")
    assert list(start_notes(plan("dora", network="loopback"), passwd))
    (finding,) = judge_logins(SYSTEM, passwd)
    assert finding.text.startswith("alice, bob can log in")
    passwd.write_text("".join(f"u{n}:x:{1000 + n}:1::/:/bin/sh\n" for n in range(7)))
    (note,) = start_notes(plan("u0"), passwd)
    assert note.startswith("u1, u2, u3 and 3 more can")


@pytest.mark.parametrize(
    "quiet",
    [
        plan("dora", network="private"),
        plan("dora", network="host"),
        plan(None, USER),
    ],
)
def test_where_nothing_is_to_be_said(passwd: Path, quiet: Plan) -> None:
    assert not list(start_notes(quiet, passwd))


def test_one_user_alone(passwd: Path, tmp_path: Path) -> None:
    passwd.write_text(PASSWD.replace("bob", "#bob").replace("1002:1002", "x:1002"))
    assert not list(start_notes(plan("dora"), passwd))
    assert not list(judge_logins(SYSTEM, passwd))
    assert not list(start_notes(plan("dora"), tmp_path / "none"))
    assert not list(judge_logins(USER, passwd))


def test_the_gateway_is_no_dataflow(tmp_path: Path) -> None:
    scope = ScopeIn(is_user=True, uid=1000, root=tmp_path)
    (tmp_path / "dora-systemd-gateway").mkdir()
    assert not has_run_here(scope)
    (tmp_path / "dora-systemd").mkdir()
    assert has_run_here(scope)
