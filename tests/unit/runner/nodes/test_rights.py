"""The rights of nodes in the cell: what the launcher gets, and when they are proved."""

from pathlib import Path

import pytest

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.begin import daemon_variables
from dora_systemd.runner.nodes.rights import check_first, launcher_rights
from tests.unit.fakes.limit_values import limits_from
from tests.unit.fakes.manager import options, with_limits, with_rights
from tests.unit.fakes.rights_values import rights_from


def with_cpus() -> RunnerOptions:
    return with_limits(options(), limits_from("camera:cpus=0,memory_limit=1G"))


def variables(unit: Path, given: RunnerOptions) -> dict[str, str]:
    return daemon_variables(given, CellPaths(unit), unit, {})


def test_most_dataflows_have_none(tmp_path: Path) -> None:
    limited = with_limits(options(), limits_from("camera:memory_limit=1G"))
    for given in (options(), limited):
        assert "DORA_SYSTEMD_RIGHTS" not in variables(tmp_path, given)


def test_the_launcher_binds_nodes_only_where_no_cgroup_does(tmp_path: Path) -> None:
    expected = "camera /usr/bin/taskset -c 0\n* \n"
    assert variables(tmp_path, with_cpus())["DORA_SYSTEMD_RIGHTS"] == expected
    (tmp_path / "cgroup.controllers").write_text("cpu cpuset\n")
    assert launcher_rights(with_cpus(), tmp_path) == ""
    rights = (rights_from("camera:scheduling=idle"),)
    line = "camera /usr/bin/chrt --idle 0\n* \n"
    assert launcher_rights(with_rights(with_cpus(), *rights), tmp_path) == line


@pytest.mark.parametrize(
    ("group", "is_proved"),
    [
        ("/dora.slice/dora-robot.service/supervisor", True),
        ("/system.slice/doractl-check-0123.service", True),
        ("/user.slice/user-1000.slice/session-1.scope", False),
    ],
)
def test_rights_are_proved_in_a_unit(group: str, is_proved: bool) -> None:
    proved: list[object] = []
    rights = (rights_from("camera:nice=5"),)
    check_first(with_rights(options(), *rights), group, proved.append)
    assert proved == [rights] * is_proved
