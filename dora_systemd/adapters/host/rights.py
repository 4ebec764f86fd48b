"""What this process and its children may do: reads it, proves it, and takes it from a process."""

import contextlib
import os
import resource
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from dora_systemd.adapters.host.process import Completed, run_command
from dora_systemd.decisions.cell.limits import CPUS, NodeLimits
from dora_systemd.decisions.cell.rights import (
    OTHERS,
    Base,
    NodeRights,
    described,
    limits_of_others,
    oom_of,
    rights_commands,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.programs import own_account
from dora_systemd.values import cpu_bits, cpu_numbers, format_cpus

_SECONDS = 20.0
_LIMITS = {"rtprio": resource.RLIMIT_RTPRIO, "nice": resource.RLIMIT_NICE}
_ENVIRONMENT = {"LC_ALL": "C"}


def read_base(bound: Mapping[str, str] | None = None) -> Base:
    """The nice value and OOM score adjustment of this process. bound: see Base. Raises OSError."""
    oom = int(Path("/proc/self/oom_score_adj").read_text())
    return Base(os.getpriority(os.PRIO_PROCESS, 0), oom, bound or {})


def prove_rights(rights: Sequence[NodeRights], run: Callable[..., Completed] = run_command) -> None:
    """Have a child of this process take the rights of each node, by `run`.

    The kernel decides by limits, capabilities, cgroup and sandbox together, so only a trial shows
    the answer. Raises DoraSystemdError (NO_PERMISSION) with the right that the kernel refuses.
    """
    if not rights:
        return
    named = {one.node: one for one in rights}
    for node, words in rights_commands(rights, read_base()).items():
        done = run([*words, "/bin/true"], _SECONDS, _ENVIRONMENT, account=own_account())
        # nice(1) runs the command without the priority, and writes a warning.
        if done.status or done.stderr:
            raise _refusal(named.get(node), node, done.stderr)


def _refusal(one: NodeRights | None, node: str, said: str) -> DoraSystemdError:
    whose = "the other nodes" if node == OTHERS else f"the node {node}"
    reason = " ".join(said.split()) or "it does not say why"
    wanted = f" ({described(one)})" if one else ""
    return DoraSystemdError(
        f"cannot give {whose} its rights{wanted}: {reason}",
        "doractl doctor says what this machine refuses; in user scope user@.service limits rights",
        ExitCode.NO_PERMISSION,
    )


def check_cpus(limits: Iterable[NodeLimits]) -> None:
    """Raise DoraSystemdError (NO_PERMISSION) for CPUs that this process may not use."""
    usable = os.sched_getaffinity(0)
    for one in limits:
        missing = set(cpu_numbers(dict(one.limits).get(CPUS, 0))) - usable
        if missing:
            raise DoraSystemdError(
                f"cannot bind the node {one.node} to the cpus {format_cpus(cpu_bits(missing))}: "
                f"the dataflow may use {format_cpus(cpu_bits(usable))}",
                "see AllowedCPUs= in systemd.resource-control(5), CPUAffinity= in systemd.exec(5)",
                ExitCode.NO_PERMISSION,
            )


def lower_rights(pid: int, node: str, rights: Sequence[NodeRights]) -> None:
    """Take from process `pid` of `node` what only others should have; ignore one that has exited.

    For nodes without a launcher, whose only right is to be essential.
    """
    one = next((one for one in rights if one.node == node), NodeRights(node))
    for name, most in limits_of_others(rights).items():
        with contextlib.suppress(OSError):
            resource.prlimit(pid, _LIMITS[name], (most, most))
    with contextlib.suppress(OSError):
        oom = oom_of(one, rights, read_base())
        Path(f"/proc/{pid}/oom_score_adj").write_text(f"{oom}\n")
