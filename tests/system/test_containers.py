"""Containers that nodes start: seen, named by a stop that leaves them, or in the node's group.

With podman as a user; of docker only the client and the cgroup are here, and both are pretended.
"""

import json
import os
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.cgroup.groups import group_path, is_populated
from tests.system.cells import Cell, Project, run, wait_for
from tests.system.chromium import Browser
from tests.system.gateways import Front
from tests.system.pages import faults

HEX = "d0c" * 21 + "e"
SCOPE = f"docker-{HEX}.scope"
NODE = """
import os, shlex, subprocess
from dora import Node
node = Node()
subprocess.Popen(shlex.split(os.environ["RUN"]))
for event in node:
    pass
"""
FLOW = "nodes: [{id: policy, path: policy.py, inputs: {tick: dora/timer/millis/500}}]\n"
# The container of the lab has no keyring, no pids controller, nothing to load images from, and an
# overlay below all its files already.
ROOTFS = """
mkdir -p ~/rootfs && cd ~/rootfs && mkdir -p bin lib lib64 proc sys dev run tmp etc usr
cp /usr/bin/sleep bin/
for one in $(ldd /usr/bin/sleep | grep -o '/[^ ]*'); do
    mkdir -p .$(dirname $one) && cp -L $one .$one
done
printf '[containers]\nkeyring=false\npids_limit=0\n' > ~/containers.conf
"""
ENVIRONMENT = ("CONTAINERS_CONF=/home/alice/containers.conf", "STORAGE_DRIVER=vfs")
PODMAN = pytest.mark.skipif(not shutil.which("podman"), reason="LAB=browser has podman")


def as_alice(*words: str, check: bool = True) -> str:
    command = shlex.join(["env", "XDG_RUNTIME_DIR=/run/user/1000", *ENVIRONMENT, *words])
    return run("su", "alice", "-s", "/bin/sh", "-c", command, check=check).stdout


def containers(text: str) -> list[dict[str, Any]]:
    (node,) = json.loads(text)["nodes"]
    found: list[dict[str, Any]] = node["containers"]
    return found


@pytest.fixture
def flow(project: Project) -> Path:
    project.write("policy.py", NODE)
    return project.write("dataflow.yml", FLOW)


@pytest.fixture
def hers(cell: Cell, flow: Path) -> Iterator[Callable[..., None]]:
    """Starts the dataflow of alice with these options of podman."""
    del cell  # for its look at the journal
    run("su", "alice", "-s", "/bin/bash", "-c", ROOTFS)
    start = ["doractl", "start", str(flow), "--name", "hers", "--sandbox", "none"]
    start += [word for one in ENVIRONMENT for word in ("--env", one)]

    def started(*options: str) -> None:
        words = ["podman", "run", "--rm", "--replace", "--network=none", *options]
        words += ["--rootfs", "/home/alice/rootfs", "sleep", "1000"]
        as_alice(*start, "--env", f"RUN={shlex.join(words)}")

    yield started
    as_alice("doractl", "stop", "--now", "hers", check=False)
    as_alice("podman", "rm", "--all", "--force", "--time", "0", check=False)
    shutil.rmtree("/home/alice/rootfs")


def container_of_alice(name: str) -> dict[str, Any]:
    def find() -> list[dict[str, Any]]:
        found = containers(as_alice("doractl", "list", "hers", "-o", "json"))
        return [one for one in found if one["cgroup"]]

    (one,) = wait_for("the container", find)
    assert (one["program"], one["name"]) == ("podman", name)
    assert one["memory_bytes"] > 0
    return one


@PODMAN
@pytest.mark.lab
@pytest.mark.warns("conmon", "podman", "libpod", "crun")
def test_podman_without_more(hers: Callable[..., None], alice: Front) -> None:
    """Its container is in a scope of its own: no limit holds, and it survives."""
    hers("--name=outer")
    one = container_of_alice("outer")
    assert not one["inside"]
    words = f"policy: podman container outer ({one['id'][:12]}, "
    for verb in ("list", "why"):
        assert words in as_alice("doractl", verb, "hers")
    assert "Running (outside: podman outer " in as_alice("doractl", "top", "hers", "--once")
    alice.up()
    labels = '{dataflow="hers",node="policy",program="podman",container="outer"}'
    metric = re.escape(f"dora_node_outside_memory_bytes{labels}")
    (memory,) = re.findall(rf"{metric} (\d+)", alice.get("/metrics", user="alice").body)
    assert int(memory) > 0
    (line,) = as_alice("doractl", "stop", "hers").splitlines()
    first, _, second = line.partition("; ")
    assert first.startswith("Dataflow stopped: ")
    assert second.startswith(f"podman container outer ({one['id'][:12]}, ")
    assert second.endswith("of policy still runs, run: podman stop outer")
    assert is_populated(group_path(one["cgroup"]))


@PODMAN
@pytest.mark.lab
@pytest.mark.warns("conmon", "podman", "libpod", "crun", "policy")
@pytest.mark.parametrize("verb", ["stop", "restart"])
def test_a_node_that_is_ended_leaves_its_container(hers: Callable[..., None], verb: str) -> None:
    """The journal says when it began, and who stops the node is told that it still runs."""
    hers("--name=outer")
    one = container_of_alice("outer")
    text = "Node policy has started a container of podman outside of its cgroup"
    wait_for("the event", lambda: text in as_alice("doractl", "logs", "hers", "--events"))
    (line,) = as_alice("doractl", "node", verb, "hers", "policy").splitlines()
    first = f"Node {verb}{'p' * (verb == 'stop')}ing: policy; podman container outer "
    assert line.startswith(f"{first}({one['id'][:12]}, ")
    assert line.endswith("of policy still runs, run: podman stop outer")
    assert verb == "restart" or as_alice("doractl", "logs", "hers", "--events").count(text) == 1


@PODMAN
@pytest.mark.lab
@pytest.mark.warns("conmon", "podman", "libpod", "crun")
def test_podman_with_split_cgroups(hers: Callable[..., None]) -> None:
    """The recipe of docs/containers.md: all that holds for the node holds for its container."""
    hers("--cgroups=split", "--name=inner")
    one = container_of_alice("inner")
    assert one["inside"]
    assert "/dora-hers.service/node-policy/" in one["cgroup"]
    for verb in ("list", "why"):
        assert "Outside" not in as_alice("doractl", verb, "hers")
    (line,) = as_alice("doractl", "stop", "hers").splitlines()
    assert line.startswith("Dataflow stopped: ")
    assert not is_populated(group_path(one["cgroup"]))


@pytest.fixture
def with_docker(cell: Cell, flow: Path, project: Project) -> None:
    """A dataflow whose node is a client of docker."""
    project.write("run", "import time\ntime.sleep(1000)\n")
    (project.root / "docker").symlink_to(sys.executable)
    cell.start(flow, "--env", f"RUN={project.root}/docker run image")
    wait_for("the client", lambda: containers(cell.doractl("list", cell.name, "-o", "json").stdout))


@contextmanager
def container_of_docker(cell: Cell) -> Iterator[None]:
    """A cgroup with a name as those of docker have."""
    scope = ("systemd-run", cell.scope.flag, f"--unit={SCOPE}", "--scope", "--slice=system.slice")
    with_pipe = [*scope, "sleep", "1000"]
    pid = os.spawnvp(os.P_NOWAIT, with_pipe[0], with_pipe)
    try:
        yield
    finally:
        run("systemctl", cell.scope.flag, "stop", SCOPE)
        os.waitpid(pid, 0)


@pytest.mark.usefixtures("with_docker")
def test_docker(cell: Cell) -> None:
    """The client says nothing of its container: it is the one that began after the client."""
    assert "a container of docker that is not known" in cell.doractl("list", cell.name).stdout
    with container_of_docker(cell):
        words = f"Outside:  policy: docker container ({HEX[:12]}, "
        wait_for("it is seen", lambda: words in cell.doractl("list", cell.name).stdout)
        done = cell.doractl("stop", cell.name, "-o", "json").stdout
        (left,) = json.loads(done)["details"]["left"]
        assert (left["node"], left["id"]) == ("policy", HEX)


@pytest.mark.lab
@pytest.mark.browser
@pytest.mark.usefixtures("with_docker")
def test_the_page_says_what_a_stop_leaves(cell: Cell, browser: Browser) -> None:
    browser.wait_text("#detail dl", "a container of docker that is not known, of policy")
    with container_of_docker(cell):
        browser.wait_text("#detail dl", f"docker container ({HEX[:12]}")
        assert faults(browser) == []
        browser.click("#detail [data-action=stop]")
        words = f"of policy runs on; afterwards run: docker stop {HEX[:12]}."
        browser.wait_text("#consequence", words)
        assert faults(browser) == []
        browser.click("#confirmed")
        browser.wait_text("#said", "of policy still runs, run: docker stop")
    assert browser.failures() == []
