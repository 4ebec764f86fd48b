"""The part of a dataflow that one machine runs."""

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.cell.launch import LaunchPlan, launch_descriptor
from dora_systemd.decisions.cell.limits import limits_of, node_limits
from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.dataflow import Dataflow, parse_dataflow
from dora_systemd.decisions.machines.part import (
    check_placed,
    differing,
    format_differing,
    format_digests,
    launch_files,
    own_dataflow,
    own_options,
    parse_digests,
    with_works,
)
from dora_systemd.errors import DoraSystemdError
from tests.unit.fakes.manager import with_limits, with_texts

UUID = "550e8400-e29b-41d4-a716-446655440000"
PLACED = (Placed("mid", "gpu"),)


def plan(**changes: Any) -> LaunchPlan:
    options = RunnerOptions("robot", UUID, "/p/flow.yml", "/p", "/bin/dora", placed=PLACED)
    options = options._replace(**changes)
    return LaunchPlan(options, "/l.pl", "/usr/bin", {"/p/a.py"}.__contains__, lambda _: b"")


def dataflow(**mid: Any) -> Dataflow:
    nodes = [
        {"id": "source", "path": "a.py", "deploy": {"machine": "here", "labels": {"x": "y"}}},
        {"id": "mid", "path": "only-there.py", "build": "make", "restart_policy": "always", **mid},
    ]
    return parse_dataflow({"nodes": nodes}, "flow.yml")


def test_the_head_says_where_a_node_runs_and_not_how() -> None:
    head = plan()
    source, mid = launch_descriptor(dataflow(), head)["nodes"]
    assert (source["deploy"]["machine"], source["deploy"]["labels"]) == (None, {})
    assert mid["path"] == "/usr/bin/perl"
    assert "launch/mid" in mid["args"]
    assert "only-there" not in str(mid)
    assert "build" not in mid
    assert mid["restart_policy"] == "always"
    finished = with_works({"nodes": [source, mid]}, {"gpu": "/run/user/5/work"})["nodes"]
    assert finished[0] == source
    assert finished[1]["deploy"] == {"machine": "gpu", "working_dir": "/run/user/5/work"}


def test_each_machine_has_its_own_nodes() -> None:
    head, member = plan().options, plan(machine="gpu").options
    assert [node.id for node in own_dataflow(head, dataflow()).nodes] == ["source"]
    assert [node.id for node in own_dataflow(member, dataflow()).nodes] == ["mid"]


def test_a_member_leaves_out_what_its_settings_say_of_other_machines() -> None:
    """Its project may be a copy of the head's, with the same settings file."""
    head, member = plan().options, plan(machine="gpu").options
    assert own_options(with_texts(head, "source:needs=/dev/video0")).has("needs")
    assert not own_options(with_texts(member, "source:needs=/dev/video0")).has("needs")
    limits = [node_limits(node, {"tasks_limit": 1}) for node in ("source", "mid")]
    assert limits_of(own_options(with_limits(member, *limits))) == (limits[1],)


def test_a_launch_file_starts_the_node_whatever_its_words_are(tmp_path: Path) -> None:
    odd = 'it\'s \\ "$HOME" @ARGV\n ü'
    given = plan(machine="gpu")
    given = LaunchPlan(given.options, "/l.pl", "/usr/bin", lambda _: True, lambda _: b"")
    only = own_dataflow(
        given.options, dataflow(path="run", args="'" + odd.replace("'", "'\\''") + "'")
    )
    text = launch_files(only, given)["mid"]
    assert "'/usr/bin/perl', '/l.pl', 'mid', '/p', 'pipe', '/p/run'" in text
    show = text.replace("'/usr/bin/perl', '/l.pl'", "'/usr/bin/printf', '%s|'")
    file = tmp_path / "launch"
    file.write_text(show)
    said = subprocess.run(["/usr/bin/perl", str(file)], capture_output=True, check=True).stdout
    assert said.decode() == f"mid|/p|pipe|/p/run|{odd}|"


def test_only_what_we_start_ourselves_can_be_elsewhere() -> None:
    check_placed(plan().options, dataflow())
    with pytest.raises(DoraSystemdError, match="node mid cannot run on machine gpu"):
        check_placed(plan().options, dataflow(path="dynamic"))


ONE, OTHER = "a" * 64, "b" * 64


def test_only_files_that_both_have_can_differ() -> None:
    told = {"sink.py": ONE, "lib/a.py": ONE, "only/there.bin": ONE}
    there = parse_digests(format_digests(told))
    assert there == told
    assert differing({"sink.py": OTHER, "lib/a.py": ONE, "mine.py": ONE}, there) == ["sink.py"]


@pytest.mark.parametrize("path", ["/etc/shadow", "../x.py", "a/../../x.py", "a\0b"])
def test_no_file_elsewhere_is_read_for_a_member(path: str) -> None:
    assert parse_digests(json.dumps({path: ONE, "x.py": "short", "y.py": 5})) == {}


@pytest.mark.parametrize("text", ["", "[]", "5", "{"])
def test_another_text(text: str) -> None:
    with pytest.raises(ValueError):
        parse_digests(text)


def test_what_people_read() -> None:
    files = ["a.py", "b.py", "c.py", "d.py"]
    assert format_differing({"gpu": []}) == ""
    assert format_differing({"gpu": ["a.py"], "arm": files}) == (
        "machine gpu runs another a.py than the one here; "
        "machine arm runs another a.py, b.py, c.py and 1 more than the one here"
    )
