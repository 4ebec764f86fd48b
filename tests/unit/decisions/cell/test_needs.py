"""The words of `needs`: what is accepted, in which form it is kept, and what is refused."""

import pytest

from dora_systemd.decisions.cell.needs import (
    NodeNeed,
    check_needs,
    needs_by_node,
    parse_needs,
    parse_node_need,
    split_needs,
)
from dora_systemd.decisions.needs.units import needs_properties
from dora_systemd.errors import DoraSystemdError


def test_each_need_is_kept_once_and_in_its_shortest_form() -> None:
    texts = ["network", " clock ", "network", "dataflow:base", "unit:a@b.service", "mount:/mnt//x/"]
    assert parse_needs(texts) == (
        *("network", "clock", "dataflow:base", "unit:a@b.service", "mount:/mnt/x"),
    )
    assert parse_needs(["camera=/dev//video0", "/dev/./video0"]) == (
        *("camera=/dev/video0", "/dev/video0"),
    )


@pytest.mark.parametrize(
    "text",
    [
        *(
            "",
            "net",
            "net:",
            "dataflow:",
            "dataflow:a/b",
            "unit:nginx",
            "unit:../x.service",
            "unit:a b.mount",
        ),
        *(
            "mount:mnt",
            "mount:/",
            "mount:/a/../b",
            "mount:/50%",
            "dev/video0",
            "camera=dev",
            "/",
            "//",
        ),
        *("/dev/\x1b[2J", "a b=/x", "=/x", "/dev/../etc", "clock=/x\n", "unit:x.service\nAfter=y"),
    ],
)
def test_other_words_are_refused_in_one_line(text: str) -> None:
    if text == "clock=/x\n":
        assert parse_needs([text]) == ("clock=/x",)  # a node may have that name
        return
    with pytest.raises(DoraSystemdError) as caught:
        parse_needs([text])
    assert "\n" not in caught.value.message + caught.value.hint
    assert caught.value.hint


@pytest.mark.parametrize(
    "name",
    [
        *("", ".", "..", "a/b", "a:b", "can%d", "can 0", "can0\x07", "can0\n", "cän0"),
        *("sixteen-letters0", "x" * 4096),
    ],
)
def test_an_interface_that_cannot_be_is_refused(name: str) -> None:
    for text in (f"net:{name}", f"arm=net:{name}"):
        if name == "can0\n":  # the end of a line is no part of a need
            assert parse_needs([text]) == (text.strip(),)
            continue
        with pytest.raises(DoraSystemdError) as caught:
            parse_needs([text])
        assert "\n" not in caught.value.message
        assert "net:can0" in caught.value.hint


def test_an_interface_is_kept_as_the_kernel_names_it() -> None:
    texts = ("net:fifteen-letters", "arm=net:can0", "net:a=b", "arm=net:enp3s0.7@", "net:7")
    assert parse_needs(texts) == texts
    _, nodes = split_needs(("arm=net:can0",), {"base": ("net:a=b", "/dev/a=/b")})
    assert needs_by_node(nodes) == {"base": ("net:a=b", "/dev/a=/b"), "arm": ("net:can0",)}
    assert parse_node_need("arm=net:a=b") == NodeNeed("arm", "net:a=b")


def test_a_dataflow_needs_no_interface() -> None:
    with pytest.raises(DoraSystemdError) as caught:
        split_needs(("net:can0",), {})
    assert caught.value.message.endswith("a network interface is what a node needs")
    assert "nodes: NODE: needs: net:can0" in caught.value.hint


def test_a_word_that_is_nearly_right_gets_a_hint() -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_needs(["netwrok"])
    assert caught.value.hint == "did you mean network?"


def test_paths_are_for_nodes_and_units_for_the_dataflow() -> None:
    given = ("network", "camera=/dev/video0")
    needs = split_needs(given, {"arm": ("/dev/ttyUSB0", "/dev/ttyUSB1")})
    nodes = (
        NodeNeed("arm", "/dev/ttyUSB0"),
        NodeNeed("arm", "/dev/ttyUSB1"),
        NodeNeed("camera", "/dev/video0"),
    )
    assert needs == (("network",), nodes)
    assert needs_by_node(nodes)["arm"] == ("/dev/ttyUSB0", "/dev/ttyUSB1")
    with pytest.raises(DoraSystemdError):
        split_needs(("/dev/video0",), {})
    for texts in (("network",), ("b=/x",)):
        with pytest.raises(DoraSystemdError):
            split_needs((), {"a": texts})


def test_the_need_of_a_node_survives_the_command_line() -> None:
    need = NodeNeed("camera.left", "/dev/v4l/by-id/a=b")
    assert parse_node_need("=".join(need)) == need
    with pytest.raises(DoraSystemdError):
        parse_node_need("network")


def test_a_node_that_dora_starts_itself_cannot_wait() -> None:
    need = [NodeNeed("camera", "/dev/video0")]
    check_needs(need, {"camera": True})
    for nodes in ({"camera": False}, {"camra": True}):
        with pytest.raises(DoraSystemdError) as caught:
            check_needs(need, nodes)
        assert "camera" in caught.value.message


def test_needs_become_dependencies_of_the_unit() -> None:
    needs = ("network", "clock", "dataflow:base", "unit:x.service", "mount:/mnt/a b")
    found = {key: one.value for key, one in needs_properties(needs, "chrony-wait.service").items()}
    wanted = ("network-online.target", "time-sync.target", "chrony-wait.service")
    assert found["Wants"] == wanted
    assert set(found["Requires"]) == {"x.service", "dora-base.service"}
    assert set(found["After"]) == {*wanted, *found["Requires"]}
    assert found["RequiresMountsFor"] == ("/mnt/a b",)
    assert needs_properties((), "chrony-wait.service") == {}


def test_the_escapes_of_a_unit_stay() -> None:
    unit = r"dev-disk-by\x2duuid-1.device"
    found = needs_properties((f"unit:{unit}",), "")
    assert (found["Requires"].value, found["After"].value) == ((unit,), (unit,))
