"""Clients of containers by their arguments, and whose container is which."""

import pytest

from dora_systemd.decisions.resources.containers import (
    Client,
    Container,
    client_of,
    container_of,
    format_left,
    format_outside,
    id_of_group,
    match_clients,
    may_be_of_daemon,
    own_monitors,
    whole_group,
)

ID, OTHER = "a" * 64, "b" * 64
NODE = "/dora.slice/dora-robot.service/node-policy"
CONMON = ("/usr/bin/conmon", "--api-version", "1", "-c", ID, "-u", ID, "-n", "hello", "-l", "x")


@pytest.mark.parametrize(
    ("arguments", "client"),
    [
        (CONMON, Client(7, "conmon", ID, "hello")),
        ((*CONMON, "-c", "cleanup"), Client(7, "conmon", ID, "hello")),
        (("conmon", "-c", ID, "-n", "a\x1b[2J; rm"), Client(7, "conmon", ID)),
        (("conmon", "-c", "../../etc"), None),
        (("conmon", "--version"), None),
        (("podman", "run", "--name", "hello", "x"), Client(7, "podman", name="hello")),
        (("podman", "--log-level", "info", "run", "--name=b", "x"), Client(7, "podman", name="b")),
        (("podman", "run", "--cgroups=split", "x"), Client(7, "podman", is_split=True)),
        (("podman", "run", "--cgroups", "split", "x"), Client(7, "podman", is_split=True)),
        (("/usr/bin/docker", "run", "--gpus=all", "x"), Client(7, "docker")),
        (("docker", "compose", "up"), Client(7, "docker")),
        (("docker", "ps"), None),
        (("python3", "docker", "run"), None),
        ((), None),
    ],
)
def test_clients(arguments: tuple[str, ...], client: Client | None) -> None:
    assert client_of(7, arguments) == client


@pytest.mark.parametrize(
    ("group", "id", "whole"),
    [
        (f"/machine.slice/libpod-{ID}.scope/container", ID, f"/machine.slice/libpod-{ID}.scope"),
        (f"/system.slice/docker-{ID}.scope", ID, f"/system.slice/docker-{ID}.scope"),
        (f"/docker/{ID}/init", ID, f"/docker/{ID}"),
        (f"{NODE}/libpod-payload-{ID}", ID, f"{NODE}/libpod-payload-{ID}"),
        (NODE, "", NODE),
        ("", "", ""),
    ],
)
def test_groups(group: str, id: str, whole: str) -> None:
    assert id_of_group(group) == id
    assert whole_group(group) == whole


def test_groups_of_daemons() -> None:
    assert may_be_of_daemon(f"docker-{ID}.scope")
    assert may_be_of_daemon(ID)
    assert not may_be_of_daemon(f"libpod-{ID}.scope")
    assert not may_be_of_daemon("init.scope")


def test_inside_and_outside() -> None:
    client = Client(7, "conmon", ID, "hello")
    inside = container_of(client, f"{NODE}/libpod-payload-{ID}/x", NODE)
    assert (inside.is_inside, inside.group) == (True, f"{NODE}/libpod-payload-{ID}")
    assert not container_of(client, f"{NODE}-2/libpod-{ID}.scope", NODE).is_inside
    forged = container_of(client, f"/user.slice/libpod-{OTHER}.scope", NODE)
    assert (forged.id, forged.name, forged.remedy) == ("", "", "")
    assert container_of(client, "", NODE) == Container("podman", ID, "hello")


def monitor(pid: int, began: float, name: str = "", uid: int = 1000) -> Client:
    return Client(pid, "conmon", f"{pid:064}", name, began, uid)


MONITORS = [
    monitor(1, 90.0),
    monitor(2, 102.0, uid=0),
    monitor(3, 103.0, "first"),
    monitor(4, 104.0, "second"),
]


def podman(name: str = "", pid: int = 50, parent: int = 9, began: float = 100.0) -> Client:
    return Client(pid, "podman", "", name, began, 1000, parent)


@pytest.mark.parametrize(
    ("clients", "found"),
    [
        ([podman()], [3]),  # the first of that user that began after the client
        ([podman("second")], [4]),
        ([podman("gone")], []),
        ([podman(), podman(pid=51, parent=50)], [3]),
        ([podman(), MONITORS[2]], [3]),
        ([MONITORS[0]], [1]),
        ([podman(began=105.0)], []),
        ([podman(began=-9000.0)], []),
        ([podman(), podman(pid=60, began=103.5)], [3, 4]),
    ],
)
def test_whose_monitor_it_is(clients: list[Client], found: list[int]) -> None:
    assert [one.pid for one in own_monitors(clients, MONITORS)] == found


def docker(began: float, pid: int = 7) -> Client:
    return Client(pid, "docker", began=began)


def test_clients_of_a_daemon() -> None:
    """By time: each has the first that began after it and that no other has."""
    old, first, second = (f"/system.slice/docker-{one * 64}.scope" for one in "0ab")
    begun = {second: 13.0, first: 11.0, old: 2.0}
    roots = dict.fromkeys(begun, 0)
    found = match_clients([docker(12.0), docker(10.0)], begun, roots)
    assert [one.group for one in found] == [first, second]
    assert found[0] == Container("docker", ID, group=first)
    assert match_clients([docker(10.0)], begun, roots, {ID})[0].id == OTHER
    assert match_clients([docker(14.0)], begun, roots) == [Container("docker")]


@pytest.mark.parametrize(("maker", "id"), [(0, ID), (7, ID), (8, ""), (None, "")])
def test_a_group_that_another_user_has_made(maker: int | None, id: str) -> None:
    """A rootless daemon belongs to the user of its client; other users may only claim a name."""
    group = f"/dora.slice/dora-other.service/docker-{ID}.scope"
    client = docker(10.0)._replace(uid=7)
    assert match_clients([client], {group: 11.0}, {group: maker})[0].id == id


HELLO = Container("podman", ID, "hello", f"/user.slice/libpod-{ID}.scope", 9 << 30)
NAMELESS = Container("docker", OTHER, group=f"/docker/{OTHER}")


def test_words() -> None:
    containers = {"policy": (HELLO, HELLO._replace(is_inside=True)), "arm": (Container("docker"),)}
    assert format_outside(containers) == (
        "policy: podman container hello (aaaaaaaaaaaa, 9G), arm: a container of docker that is "
        "not known; no limit of a node holds there"
    )
    assert format_outside({"policy": (HELLO._replace(is_inside=True),)}) == ""


def test_what_a_stop_has_left() -> None:
    assert format_left([]) == ""
    unknown = Container("podman", group="/x")
    assert (
        format_left([("a", unknown)]) == "a container of podman that is not known of a still runs"
    )
    assert format_left([("policy", HELLO), ("arm", NAMELESS)]) == (
        "podman container hello (aaaaaaaaaaaa, 9G) of policy, docker container (bbbbbbbbbbbb) of "
        "arm still run, run: podman stop hello; docker stop bbbbbbbbbbbb"
    )


def test_values() -> None:
    assert HELLO.values() == {
        "program": "podman",
        "id": ID,
        "name": "hello",
        "cgroup": HELLO.group,
        "memory_bytes": 9 << 30,
        "inside": False,
    }
