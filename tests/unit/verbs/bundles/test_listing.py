"""What is printed of bundles, which anybody may have written."""

import json
from pathlib import Path

import pytest

from dora_systemd.errors import DoraSystemdError
from dora_systemd.verbs.bundles.listing import (
    find_bundle,
    find_name,
    kept_names,
    parse_why,
    read_parts,
    shown_readme,
)
from tests.unit.fakes.manager import FakeManager, ScopeIn


def test_no_text_of_a_bundle_controls_the_terminal(tmp_path: Path) -> None:
    assert "\x1b" not in shown_readme("a\x1b]0;x\x07\nb\n", 80)
    for data in (b"", b"{", b"\xff", b"[" * 100_000):
        with pytest.raises(DoraSystemdError, match="is not JSON"):
            parse_why(data, tmp_path / "x")
    assert json.dumps(parse_why(b"[]", tmp_path)) == "{}"


def test_only_lines_of_logs_are_cut() -> None:
    """What a bundle can contain must be read whole, and a command must be copied."""
    text = (
        "Bundle of dataflow robot on lab\n\n"
        "  Before:   stopped by root (doractl restart) at noon\n"
        "  11-28 03:51:10  Dataflow robot is running, all nodes are ready\n"
        "  03:51:10  the line of a node is as long as it wants\n"
        "  why.json      the report above, for programs\n"
        "  /usr/lib/systemd/systemd-journal-remote -o bundle.journal journal.export\n"
        "Never in a bundle: values of environment variables\n"
    )
    assert shown_readme(text, None) == text.rstrip("\n")
    assert shown_readme(text, 40).split("\n") == [
        "Bundle of dataflow robot on lab",
        "",
        "  Before:   stopped by root (doractl",
        "            restart) at noon",
        "  11-28 03:51:10  Dataflow robot is run…",
        "  03:51:10  the line of a node is as lo…",
        "  why.json      the report above, for",
        "                programs",
        "  /usr/lib/systemd/systemd-journal-remote -o bundle.journal journal.export",
        "Never in a bundle: values of environment",
        "variables",
    ]


def test_a_dataflow_is_known_by_its_bundles(scope: ScopeIn, manager: FakeManager) -> None:
    assert kept_names(scope) == []
    (scope.state_root / "dora-systemd/bundles/robot").mkdir(parents=True)
    (scope.state_root / "dora-systemd/bundles/.x").mkdir()
    assert kept_names(scope) == ["robot"]
    assert find_name(manager, scope, "dora-robot.service") == "robot"


def test_only_what_the_store_has_is_read(scope: ScopeIn, tmp_path: Path) -> None:
    store = scope.state_root / "dora-systemd/bundles/robot"
    store.mkdir(parents=True)
    known = "robot-20261127T041500Z-requested.tar"
    link = "robot-20261127T041501Z-requested.tar"
    (store / known).write_bytes(b"x" * 3_000_000)
    (store / "secret").write_text("no bundle")
    (tmp_path / "outside").write_text("secret")
    (store / link).symlink_to(tmp_path / "outside")
    found = find_bundle(scope, "robot", known)
    assert found is not None
    parts = list(read_parts(found))
    assert (len(parts) > 1, sum(map(len, parts))) == (True, found.size)
    wrong = [("robot", "secret"), ("robot", f"../robot/{known}"), ("../bundles/robot", known)]
    for name, ident in [*wrong, ("", known), ("robot", ""), ("nobody", known)]:
        assert find_bundle(scope, name, ident) is None
    followed = find_bundle(scope, "robot", link)
    assert followed is not None
    with pytest.raises(OSError):
        next(read_parts(followed))
