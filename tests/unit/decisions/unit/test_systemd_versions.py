"""What older systemd versions lack."""

import pytest

from dora_systemd.decisions.properties.assignments import parse_property
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.unit.systemd_versions import drop_unsupported, transient_commands
from dora_systemd.errors import DoraSystemdError, ExitCode


def properties(*assignments: str) -> dict[str, Property]:
    return {slot: one for text in assignments for slot, one in parse_property(text).items()}


def test_what_all_know_is_kept() -> None:
    given = properties("Nice=5", "MemoryMax=50%", "LimitNOFILE=5")
    assert drop_unsupported(given, 252) == (given, ())


@pytest.mark.parametrize(
    ("assignment", "version"),
    [
        ("MemoryZSwapMax=50%", 253),
        ("RestartSteps=5", 254),
        ("RestartMaxDelaySec=5", 254),
        ("MemoryKSM=yes", 254),
        ("CoredumpReceive=yes", 255),
        ("WantsMountsFor=/srv", 256),
        ("PrivatePIDs=yes", 257),
        ("PrivateTmp=disconnected", 257),
    ],
)
def test_what_is_newer_is_left_out_with_a_warning(assignment: str, version: int) -> None:
    given = properties("Nice=5", assignment)
    key = assignment.partition("=")[0]
    kept, warnings = drop_unsupported(given, version - 1)
    assert kept == properties("Nice=5")
    assert warnings == (
        f"{key}= is left out: systemd {version - 1} lacks it, version {version} has it",
    )
    assert drop_unsupported(given, version) == (given, ())


def test_a_value_of_ours_is_left_out_with_a_warning_if_it_is_given() -> None:
    text = "FileDescriptorStorePreserve=yes"
    wanted = properties(text)
    assert drop_unsupported(wanted, 253) == ({}, ())
    assert [one.partition("=")[0] for one in drop_unsupported(wanted, 253, (text,))[1]] == [
        "FileDescriptorStorePreserve"
    ]
    assert drop_unsupported(wanted, 254, (text,)) == (wanted, ())


def test_the_subgroup_is_the_runners_work_on_debian_12() -> None:
    given = {"DelegateSubgroup": Property("DelegateSubgroup", "s", "supervisor")}
    assert drop_unsupported(given, 253) == ({}, ())
    assert drop_unsupported(given, 254) == (given, ())


@pytest.mark.parametrize("version", [0, 251])
def test_too_old_versions_are_refused(version: int) -> None:
    with pytest.raises(DoraSystemdError, match=f"cannot use systemd {version}") as caught:
        drop_unsupported({}, version)
    assert caught.value.code == ExitCode.NO_SYSTEMD
    assert "252" in caught.value.hint


def test_command_lines_of_transient_units() -> None:
    """Systemd 252 forgets ExecStartEx at a daemon-reload."""
    told = [*properties("ExecStop=-:/bin/x a", "ExecStopPost=/bin/y b", "Nice=5").values()]
    assert transient_commands(told, 257) == told
    assert transient_commands(told, 252) == [
        ("ExecStop", "a(sasb)", (("/bin/x", ("/bin/x", "a"), True),)),
        ("ExecStopPost", "a(sasb)", (("/bin/y", ("/bin/y", "b"), False),)),
        ("Nice", "i", 5),
    ]


@pytest.mark.parametrize("command", ["+/bin/x", "!/bin/x", "/bin/x $A", ":/srv/$x/y", "/bin/`x`"])
def test_command_lines_that_an_older_systemd_would_not_keep(command: str) -> None:
    told = [*properties(f"ExecStartPre={command}").values()]
    assert transient_commands(told, 257) == told
    with pytest.raises(DoraSystemdError, match=r"^cannot keep ExecStartPre=") as caught:
        transient_commands(told, 252)
    assert caught.value.code == ExitCode.USAGE
