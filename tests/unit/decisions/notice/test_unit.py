"""The unit of a notice has the sandbox of the nodes, and bounds of its own."""

from typing import Any

import pytest

from dora_systemd.decisions.notice.unit import NoticeUnit, names_to_copy, notice_properties
from dora_systemd.decisions.properties.sandbox import LEVELS, NETWORKS, Sandbox, sandbox_properties

UNIT = NoticeUnit(
    name="robot",
    uuid="u",
    words=("/bin/tell", "$x %n"),
    directory="/srv/robot",
    environment=("PATH=/bin", "DORA_NOTICE_COUNT=1"),
    stdin="/run/doranotice/robot/why.txt",
    evidence="/run/doranotice/robot/why.json",
    cell_directory="/run/dora-systemd/robot",
    is_user=False,
)


class Types(dict[str, str]):
    """A systemd that has all properties but the newest."""

    def __contains__(self, key: object) -> bool:
        return not str(key).endswith("Ex")

    def __missing__(self, key: str) -> str:
        return "s"


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("is_root", [False, True])
@pytest.mark.parametrize("has_devices", [False, True])
def test_all_of_the_sandbox_is_copied(
    level: str, network: str, is_root: bool, has_devices: bool
) -> None:
    """A new property of the sandbox has to be in the list."""
    sandbox = Sandbox(
        level=level,
        network=network,
        is_root=is_root,
        has_devices=has_devices,
        needed=["/home/x/robot"],
        writable=["/tmp/x", "/srv/x"],
        directory="/run/dora-systemd/robot",
    )
    wanted = {one.name for one in sandbox_properties(sandbox).values()}
    names = names_to_copy(Types())
    assert {one.removesuffix("Ex") for one in wanted} <= {*names}


def test_a_newer_property_is_read_in_its_place() -> None:
    types = {"PrivateUsers": "b", "PrivateUsersEx": "s", "UMask": "u"}
    assert names_to_copy(types) == ["UMask", "PrivateUsersEx"]


def made(copied: dict[str, Any], unit: NoticeUnit = UNIT) -> dict[str, Any]:
    return {one.name: one.value for one in notice_properties(unit, copied, Types())}


def test_no_shell_no_loop_and_bounds() -> None:
    found = made({"User": "alice"})
    assert found["ExecStartEx"] == (("/bin/tell", ("/bin/tell", "$x %n"), ("no-env-expand",)),)
    assert not found.keys() & {"OnFailure", "OnSuccess", "Restart", "Wants"}
    assert found["TimeoutStartUSec"] == 30_000_000
    assert found["MemoryMax"] == 128 * 1024 * 1024
    assert found["MemorySwapMax"] == 0
    assert found["LogRateLimitBurst"] == 100
    assert found["User"] == "alice"


def test_nothing_that_nodes_wrote_is_in_the_unit() -> None:
    """Every user can read the properties of a unit: the report is in files of root."""
    found = made({"User": "alice", "LoadCredential": [["key", "/etc/key"]]})
    assert found["StandardInputFile"] == UNIT.stdin
    assert "StandardInputData" not in found
    assert found["LoadCredential"] == (("key", "/etc/key"), ("why.json", UNIT.evidence))


def test_what_is_gone_after_a_failure_is_not_mounted() -> None:
    binds = [
        ["/run/dora-systemd/robot", "/run/dora-systemd/robot", False, 16384],
        ["/srv/x", "/srv/x", False, 16384],
    ]
    found = made({"BindPaths": binds, "BindReadOnlyPaths": [["/opt", "/opt", False, 0]]})
    assert found["BindPaths"] == [("/srv/x", "/srv/x", True, 16384)]
    assert found["BindReadOnlyPaths"] == [("/opt", "/opt", True, 0)]


def test_empty_values_mean_nothing_but_for_capabilities() -> None:
    copied = {"CapabilityBoundingSet": 0, "NoNewPrivileges": False, "SystemCallFilter": [False, []]}
    found = made(copied)
    assert found["CapabilityBoundingSet"] == 0
    assert not found.keys() & {"NoNewPrivileges", "SystemCallFilter"}


def test_in_user_scope() -> None:
    found = made({"LoadCredential": [["key", "/etc/key"]]}, UNIT._replace(is_user=True))
    assert found["LoadCredential"] == [["key", "/etc/key"]]
    assert not found.keys() & {"LogRateLimitBurst", "LogExtraFields"}
