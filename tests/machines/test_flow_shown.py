"""What is shown of a dataflow over several machines, and what a member refuses."""

import json
from collections.abc import Iterator
from typing import Any

import pytest

from dora_systemd.errors import ExitCode
from tests.machines.flows import NAME, PLACE, Flow, flow_on
from tests.machines.wires import there
from tests.system.cells import run, wait_for

FILE = f"{PLACE}/dataflow.yml"


@pytest.fixture(scope="module")
def flow() -> Iterator[Flow]:
    """A dataflow that runs on a, b and c."""
    reload_refused = ("Control process exited", "Reload failed for dora-flow")
    with flow_on(Flow({"gpu": "b", "arm": "c"}), reload_refused) as flow:
        flow.start("--restart-policy=on-failure")
        flow.wait_exchanging()
        yield flow


def test_one_row_with_the_machine_of_each_node(flow: Flow) -> None:
    table = flow.cell.doractl("list").stdout.splitlines()
    assert [line.split()[1] for line in table[1:]] == [NAME]
    shown = flow.cell.doractl("list", NAME).stdout
    assert "Machines: head, gpu, arm\n" in shown
    nodes = [line.split()[:3] for line in shown.partition("\n\n")[2].splitlines()]
    assert nodes == [
        ["NODE", "MACHINE", "STATE"],
        ["source", "head", "Running"],
        ["doubler", "gpu", "Running"],
        ["sink", "arm", "Running"],
    ]
    assert "doubler on gpu" in flow.cell.doractl("top", "--once").stdout
    why = flow.cell.doractl("why", NAME).stdout
    assert "Machines: head, gpu (b), arm (c)" in why


def test_what_nodes_on_other_machines_use(flow: Flow) -> None:
    def is_known(node: dict[str, Any]) -> bool:
        return bool(node["memory_bytes"] and node["cpu_percent"])

    wait_for("the members have told", lambda: all(map(is_known, flow.table().values())))
    shown = [line.split() for line in flow.cell.doractl("list", NAME).stdout.splitlines()]
    (doubler,) = [line for line in shown if line[:1] == ["doubler"]]
    assert "-" not in doubler[4:6], "CPU% and MEM"
    there_says = json.loads(there("b", "doractl", "list", NAME, "-o", "json").stdout)
    known = flow.table()["doubler"]["memory_bytes"]
    assert isinstance(known, int)
    assert 0.5 < known / there_says["nodes"][0]["memory_bytes"] < 2


def test_the_part_of_a_member(flow: Flow) -> None:
    del flow
    part = json.loads(there("b", "doractl", "list", NAME, "-o", "json").stdout)
    assert part["machine"] == "gpu"
    assert [node["node"] for node in part["nodes"]] == ["doubler"]
    assert part["nodes"][0]["memory_bytes"]
    assert part["nodes"][0]["pid"]
    for command in ("stop flow", "restart flow", "reload flow", "set flow --memory-limit 1G"):
        done = there("b", "doractl", command)
        assert done.returncode == ExitCode.FAILURE, done.stderr
        assert "machine gpu, and the head is a\n" in done.stderr
        assert "hint: on a: doractl" in done.stderr


def test_logs_of_all_machines(flow: Flow) -> None:
    def lines(*words: str) -> list[str]:
        return flow.cell.doractl("logs", NAME, *words).stdout.splitlines()

    wait_for("the sink has spoken", lambda: any("got" in line for line in lines("-n", "50")))
    assert {line.split()[0] for line in lines()} == {"head", "gpu", "arm"}
    objects = [json.loads(line) for line in lines("-o", "json", "--node", "sink")]
    assert {(one["machine"], one["DORA_NODE"]) for one in objects} == {("arm", "sink")}
    # Not each: a record may have several lines, of which the first one names the node.
    told = lines("--node", "sink")
    assert any("sink" in line for line in told), told
    assert not any(" source " in line or " doubler " in line for line in told), told
    assert lines("--machine", "head")
    # Before, another test may have had the sink there.
    assert not [one for one in lines("--machine", "head", "--run=CURRENT") if " got " in one]
    wrong = flow.cell.doractl("logs", NAME, "--machine", "nose", check=False)
    assert (wrong.returncode, "valid values: head, gpu, arm" in wrong.stderr) == (2, True)


def test_what_cannot_be_made_of_it(flow: Flow) -> None:
    done = flow.cell.doractl("export", NAME, check=False)
    assert done.returncode == ExitCode.BAD_INPUT
    assert "it runs on several machines" in done.stderr
    life = flow.life()
    for words in (["reload", NAME], ["set", NAME, "--hot-reload=on"]):
        done = flow.cell.doractl(*words, check=False)
        assert done.returncode == ExitCode.FAILURE, done.stderr
        assert "it runs on several machines" in done.stderr
        assert "doractl restart flow" in done.stderr
    assert run("systemctl", "reload", flow.cell.unit, check=False).returncode == 1
    assert flow.life() == life
    limit = flow.cell.doractl("set", NAME, "--node=sink:memory_limit=1G", check=False)
    assert "it runs on machine arm" in limit.stderr


def test_a_plan_shows_all_units() -> None:
    flow = Flow({"gpu": "b"})
    flow.bring()
    more = ("--name", "other", "--env", "A=1", "--node", "doubler:memory_limit=1G")
    shown = run("doractl", "start", FILE, *flow.flags(), *more, "--dry-run").stdout
    head, _, link = shown.partition("\n# doralink-other:gpu.service\n")
    assert "--placed=doubler=gpu" in head
    assert "memory" not in head
    assert link.startswith("# machine gpu: b\n")
    for word in ("member", "--placed=doubler=gpu", "--env=A=1", "--set=doubler:memory_limit=1G"):
        assert word in link
    assert not there("b", "systemctl", "-q", "list-units", "dora-other*").stdout.strip()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ([], "node doubler: its machine 'gpu' is not declared"),
        (["--machine=gpu=b", "--machine=npu=c"], "no node runs on machine npu"),
        (["--machine=gpu=b", "--network=private"], "the network is private"),
        (["--machine=gpu=b", "--hot-reload"], "hot reload"),
    ],
)
def test_refusals_before_any_unit(words: list[str], text: str) -> None:
    Flow({"gpu": "b"}).bring()
    done = run("doractl", "start", FILE, "--name", "other", *words, check=False)
    assert done.returncode == ExitCode.BAD_INPUT, done.stderr
    assert text in done.stderr
    units = run("systemctl", "-q", "list-units", "--all", "dora-other*", "doralink-other*").stdout
    assert not units.strip()
    for verb in ("run", "deploy"):
        refused = run("doractl", verb, FILE, "--name", "other", "--machine=gpu=b", check=False)
        assert refused.returncode == ExitCode.BAD_INPUT, refused.stderr
