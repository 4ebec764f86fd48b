"""The options of a runner, as its nodes see them."""

from pathlib import Path

import pytest

from dora_systemd.adapters.dora.preparation import prepare, resolved
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.errors import DoraSystemdError


def test_directories_are_resolved_and_the_file_is_not(tmp_path: Path) -> None:
    real, link = tmp_path / "real", tmp_path / "link"
    real.mkdir()
    link.symlink_to(real)
    (real / "now.yml").symlink_to("other.yml")
    given = RunnerOptions("x", "", f"{link}/now.yml", f"{real}/../link", "/dora")
    made = resolved(given)
    assert (made.dataflow, made.working_directory) == (f"{real}/now.yml", str(real))
    assert resolved(made) == made


def test_a_name_that_leaves_no_room_for_a_session(tmp_path: Path) -> None:
    path = tmp_path / f"{'x' * 245}.yml"
    path.write_text("nodes: [{id: a, path: a.py}]\n")
    (tmp_path / "a.py").touch()
    (tmp_path / "out").mkdir()
    options = RunnerOptions("robot", "uuid", str(path), str(tmp_path), "/bin/true")
    assert [node.id for node in prepare(options, {}).dataflow.nodes] == ["a"]


def test_a_module_that_dora_does_not_expand_and_says_nothing_of(tmp_path: Path) -> None:
    path = tmp_path / "flow.yml"
    path.write_text("nodes: [{id: a, module: a.yml}]\n")
    options = RunnerOptions("robot", "uuid", str(path), str(tmp_path), "/bin/false")
    with pytest.raises(DoraSystemdError) as caught:
        prepare(options, {})
    assert caught.value.message == f"cannot expand {path}: dora refuses it"
    assert caught.value.hint == f"see /bin/false expand {path}"
