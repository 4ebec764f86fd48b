"""The needs of a dataflow as dependencies of its unit, see systemd.unit(5).

systemd waits for them before it starts the runner, so no restart and no timeout is used up.
"""

from dora_systemd.decisions.cell.needs import CLOCK, DATAFLOW, MOUNT, NETWORK, UNIT
from dora_systemd.decisions.properties.assignments import typed, with_assignments
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.names import unit_name

NETWORK_UNIT = "network-online.target"
CLOCK_UNIT = "time-sync.target"
CHRONY, TIMESYNCD = "chrony-wait.service", "systemd-time-wait-sync.service"
CLOCK_WAITERS = (CHRONY, TIMESYNCD)
"""The services that wait until the clock is right; time-sync.target alone waits for nothing."""


def required_units(needs: tuple[str, ...]) -> dict[str, str]:
    """By need, the unit that has to run for as long as the dataflow does."""
    units = {one: one.removeprefix(UNIT) for one in needs if one.startswith(UNIT)}
    dataflows = (one for one in needs if one.startswith(DATAFLOW))
    return units | {one: unit_name(one.removeprefix(DATAFLOW)) for one in dataflows}


def needed_mounts(needs: tuple[str, ...]) -> list[str]:
    """The paths whose file systems are needed."""
    return [one.removeprefix(MOUNT) for one in needs if one.startswith(MOUNT)]


def needs_properties(needs: tuple[str, ...], clock: str) -> dict[str, Property]:
    """The dependencies. clock: the one of CLOCK_WAITERS that works here, or "".

    Requires=, not BindsTo=: a stop of the other unit stops the dataflow in both, but systemd only
    starts the dataflow again after a failure of the other unit if that is required.
    """
    wanted = [NETWORK_UNIT] if NETWORK in needs else []
    wanted += [CLOCK_UNIT, *([clock] if clock else [])] if CLOCK in needs else []
    # As in a unit file, in which the escapes of a unit's name have to be escaped.
    required = [one.replace("\\", "\\\\") for one in required_units(needs).values()]
    lines = [f"Wants={one}" for one in wanted]
    lines += [f"Requires={one}" for one in required]
    lines += [f"After={one}" for one in (*wanted, *required)]
    mounts = tuple(needed_mounts(needs))
    return with_assignments({}, lines) | (typed(RequiresMountsFor=mounts) if mounts else {})
