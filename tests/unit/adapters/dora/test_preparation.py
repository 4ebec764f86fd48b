"""The options of a runner, as its nodes see them."""

from pathlib import Path

from dora_systemd.adapters.dora.preparation import resolved
from dora_systemd.decisions.cell.options import RunnerOptions


def test_directories_are_resolved_and_the_file_is_not(tmp_path: Path) -> None:
    real, link = tmp_path / "real", tmp_path / "link"
    real.mkdir()
    link.symlink_to(real)
    (real / "now.yml").symlink_to("other.yml")
    given = RunnerOptions("x", "", f"{link}/now.yml", f"{real}/../link", "/dora")
    made = resolved(given)
    assert (made.dataflow, made.working_directory) == (f"{real}/now.yml", str(real))
    assert resolved(made) == made
