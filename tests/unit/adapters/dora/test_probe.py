"""Which Python runs the probe: one that has dora-rs, that of the nodes first."""

import sys
from pathlib import Path

import pytest

from dora_systemd.adapters.dora.probe import probe_python
from dora_systemd.decisions.cell.launch import LaunchPlan
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.errors import DoraSystemdError, ExitCode


def plan(project: Path, environment: dict[str, str]) -> LaunchPlan:
    options = RunnerOptions("robot", "uuid", str(project / "flow.yml"), str(project), "/bin/dora")
    python = {f"{Path(sys.executable).parent}/python"}
    search = str(Path(sys.executable).parent)
    return LaunchPlan(
        *(options, "/l.pl", search, python.__contains__, Path.read_bytes),  # type: ignore[arg-type]
        environment=environment,
    )


def test_the_interpreter_itself(tmp_path: Path) -> None:
    (tmp_path / "site" / "dora").mkdir(parents=True)
    (tmp_path / "site" / "dora" / "__init__.py").touch()
    given = plan(tmp_path, {"PYTHONPATH": str(tmp_path / "site")})
    found = probe_python(given)
    assert Path(found).samefile(sys.executable)


def test_a_directory_of_the_project_is_no_library(tmp_path: Path) -> None:
    """Whoever has a directory named dora beside the dataflow still needs dora-rs."""
    (tmp_path / "dora_of_ours").mkdir()
    (tmp_path / "dora_of_ours" / "__init__.py").touch()
    with pytest.raises(DoraSystemdError) as caught:
        # Another name: the Python that runs this test may have dora-rs.
        probe_python(plan(tmp_path, {}), "dora_of_ours")
    assert caught.value.message.endswith("/python has no dora-rs")
    assert "pip install dora-rs" in caught.value.hint
    assert caught.value.code == ExitCode.BAD_INPUT
