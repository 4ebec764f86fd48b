"""Rights of this process and its children, as the kernel has them."""

import os
import resource
import subprocess
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.host.process import Completed, run_command
from dora_systemd.adapters.host.rights import (
    check_cpus,
    lower_rights,
    prove_rights,
    read_base,
)
from dora_systemd.decisions.cell.rights import BEHIND_ESSENTIAL, NodeRights
from dora_systemd.errors import DoraSystemdError, ExitCode
from tests.unit.fakes.limit_values import limits_from
from tests.unit.fakes.rights_values import rights_from


def test_base_of_this_process() -> None:
    base = read_base({"a": "0"})
    assert base.nice == os.getpriority(os.PRIO_PROCESS, 0)
    assert base.oom == int(Path("/proc/self/oom_score_adj").read_text())
    assert base.bound == {"a": "0"}


class Prover:
    """Runs what takes the rights, and notes it. instead: runs this in its place."""

    def __init__(self, *instead: str) -> None:
        self.instead = instead
        self.done: list[Completed] = []
        self.commands: list[list[str]] = []

    def __call__(self, command: list[str], *words: Any, **more: Any) -> Completed:
        self.commands.append(command)
        self.done.append(run_command(self.instead or command, *words, **more))
        return self.done[-1]


def test_what_everybody_may_have_is_proved() -> None:
    prove_rights([], prove := Prover())
    assert not prove.commands
    rights = [rights_from("a:scheduling=idle,essential=yes"), rights_from("b:nice=19")]
    prove_rights(rights, prove)
    assert prove.done == [Completed(0, "", "")] * 3
    idle, nice, _ = prove.commands
    assert idle[-4:] == ["/usr/bin/chrt", "--idle", "0", "/bin/true"]
    assert nice[-4] == "/usr/bin/nice"


def test_what_the_kernel_refuses_is_an_error() -> None:
    """The lower the wanted value, the less any kernel would allow: this one is below all."""
    prove = Prover("/usr/bin/choom", "-n", "-2000", "--", "/bin/true")
    with pytest.raises(DoraSystemdError) as caught:
        prove_rights([NodeRights("camera", oom_score_adjust=-1000)], prove)
    start = "cannot give the node camera its rights (oom_score_adjust -1000): choom: "
    assert caught.value.message.startswith(start)
    assert "\n" not in caught.value.message
    assert caught.value.code is ExitCode.NO_PERMISSION


def test_a_program_that_only_complains_is_a_refusal() -> None:
    """nice(1) runs the program without the priority."""
    prove = Prover("/bin/sh", "-c", "echo 'nice: cannot set niceness' >&2")
    with pytest.raises(DoraSystemdError, match=r"camera its rights \(nice -5\): nice: cannot"):
        prove_rights([NodeRights("camera", nice=-5)], prove)


def test_cpus_of_this_process() -> None:
    usable = sorted(os.sched_getaffinity(0))
    check_cpus([limits_from(f"a:cpus={usable[0]}"), limits_from("b:memory_limit=1G")])
    with pytest.raises(DoraSystemdError, match="the node c to the cpus 8191: the dataflow may"):
        check_cpus([limits_from(f"c:cpus={usable[-1]},8191")])


def test_a_process_without_a_launcher_loses_what_others_have() -> None:
    rights = [rights_from("a:scheduling=fifo:5,nice=-5,essential=yes")]
    with subprocess.Popen(["/bin/sleep", "60"]) as child:
        lower_rights(child.pid, "ros", rights)
        for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_NICE):
            assert resource.prlimit(child.pid, limit) == (0, 0)
        oom = int(Path(f"/proc/{child.pid}/oom_score_adj").read_text())
        assert oom == min(read_base().oom + BEHIND_ESSENTIAL, 1000)
        child.kill()
    lower_rights(child.pid, "ros", rights)
