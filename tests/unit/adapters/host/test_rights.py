"""Rights of this process and its children, as the kernel has them."""

import os
import resource
import subprocess
from pathlib import Path

import pytest

from dora_systemd.adapters.host import rights as host
from dora_systemd.adapters.host.rights import (
    check_cpus,
    lower_rights,
    prove_rights,
    read_base,
)
from dora_systemd.decisions.cell.limits import parse_node_limits
from dora_systemd.decisions.rights.commands import BEHIND_ESSENTIAL, Base
from dora_systemd.decisions.rights.node_rights import NodeRights, parse_node_rights
from dora_systemd.errors import DoraSystemdError, ExitCode


def test_base_of_this_process() -> None:
    base = read_base({"a": "0"})
    assert base.nice == os.getpriority(os.PRIO_PROCESS, 0)
    assert base.oom == int(Path("/proc/self/oom_score_adj").read_text())
    assert base.bound == {"a": "0"}


def test_what_everybody_may_have_is_proved() -> None:
    prove_rights([])
    prove_rights([parse_node_rights("a:scheduling=idle,essential"), parse_node_rights("b:nice=19")])


def test_what_the_kernel_refuses_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lower the wanted value, the less any kernel would allow: this one is below all."""
    monkeypatch.setattr(host, "read_base", lambda: Base())
    words = {"camera": ["/usr/bin/choom", "-n", "-2000", "--"], "*": []}
    monkeypatch.setattr(host, "rights_commands", lambda *_: words)
    with pytest.raises(DoraSystemdError) as caught:
        prove_rights([NodeRights("camera", oom_score_adjust=-1000)])
    start = "cannot give the node camera its rights (oom_score_adjust -1000): choom: "
    assert caught.value.message.startswith(start)
    assert "\n" not in caught.value.message
    assert caught.value.code is ExitCode.NO_PERMISSION


def test_a_program_that_only_complains_is_a_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    """nice(1) runs the program without the priority."""
    script = ["/bin/sh", "-c", "echo 'nice: cannot set niceness' >&2"]
    monkeypatch.setattr(host, "rights_commands", lambda *_: {"*": script})
    with pytest.raises(DoraSystemdError, match="the other nodes its rights: nice: cannot"):
        prove_rights([NodeRights("camera", nice=-5)])


def test_cpus_of_this_process() -> None:
    usable = sorted(os.sched_getaffinity(0))
    check_cpus([parse_node_limits(f"a:cpus={usable[0]}"), parse_node_limits("b:memory=1G")])
    with pytest.raises(DoraSystemdError, match="the node c to the cpus 8191: the dataflow may"):
        check_cpus([parse_node_limits(f"c:cpus={usable[-1]},8191")])


def test_a_process_without_a_launcher_loses_what_others_have() -> None:
    rights = [parse_node_rights("a:scheduling=fifo:5,nice=-5,essential")]
    with subprocess.Popen(["/bin/sleep", "60"]) as child:
        lower_rights(child.pid, "ros", rights)
        for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_NICE):
            assert resource.prlimit(child.pid, limit) == (0, 0)
        oom = int(Path(f"/proc/{child.pid}/oom_score_adj").read_text())
        assert oom == min(read_base().oom + BEHIND_ESSENTIAL, 1000)
        child.kill()
    lower_rights(child.pid, "ros", rights)
