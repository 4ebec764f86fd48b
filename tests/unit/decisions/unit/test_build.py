"""The unit of a build: the sandbox of the dataflow, and nothing else of it."""

from dora_systemd.decisions.properties.assignments import typed, with_assignments
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.unit.build import build_properties

SANDBOX = ["ProtectSystem=strict", "NoNewPrivileges=yes", "TemporaryFileSystem=/run/x:ro"]
OTHERS = [
    *("LoadCredential=a:/b", "CPUSchedulingPolicy=fifo", "Nice=-5", "LimitRTPRIO=50"),
    *("Requires=other.service", "After=other.service", "OOMScoreAdjust=-500"),
]


def made(own: dict[str, Property], is_user: bool = False) -> dict[str, Property]:
    return build_properties(own, "/s/.build/tree", "/s/n/id/tree", "/s", {"A": "b"}, 7, is_user)


def test_it_has_the_sandbox_and_no_rights() -> None:
    own = with_assignments({}, [*SANDBOX, *OTHERS]) | typed(User="eve", Slice="dora.slice")
    found = made(own)
    for key in ("ProtectSystem", "NoNewPrivileges", "User", "Slice"):
        assert found[key] == own[key]
    for line in OTHERS:
        assert not any(slot.startswith(line.partition("=")[0]) for slot in found)
    assert found["TemporaryFileSystem"].value == (("/run/x", "ro"), ("/s", "ro"))
    assert found["BindPaths"].value[0][:2] == ("/s/.build/tree", "/s/n/id/tree")
    assert (found["Type"].value, found["TimeoutStartSec"].value) == ("oneshot", 7)
    assert found["Environment"].value == ("A=b",)
    assert "PrivateUsers" not in found


def test_a_limit_of_memory_is_kept() -> None:
    assert made({})["MemoryMax"].name == "MemoryMaxScale"
    own = with_assignments({}, ["MemoryMax=1G"])
    assert made(own)["MemoryMax"].value == 1024**3


def test_in_user_scope_mounts_need_a_namespace() -> None:
    assert made({}, is_user=True)["PrivateUsers"].value is True
