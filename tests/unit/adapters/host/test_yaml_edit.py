"""One value of a settings file is changed; comments, order and style stay, and so does all else."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.adapters.host.files import parse_yaml
from dora_systemd.adapters.host.yaml_edit import with_value

FILE = """\
# the robot
memory_limit: 1G   # all
nodes:
  # eyes
  camera:
    memory_limit: "300M"  # tight
    stop: {within: 5s}    # fast
    owes:
      - output: image
        within: 2s   # slow
      - {output: depth, within: 3s}
    # the end of camera
  detector: {cpu_limit: 1.0}
  idle:   # nothing
  plot:
    needs:
    - /dev/a
    - /dev/b

# the end
"""


@pytest.mark.parametrize(
    ("place", "before", "after"),
    [
        ("memory_limit", "memory_limit: 1G   # all\n", "memory_limit: 7   # all\n"),
        ("nodes camera memory_limit", '"300M"  # tight', "7  # tight"),
        ("nodes camera stop within", "{within: 5s}    # fast", "{within: 7}    # fast"),
        ("nodes camera owes image within", "2s   # slow", "7   # slow"),
        ("nodes camera owes depth within", "within: 3s}", "within: 7}"),
        (
            "nodes camera cpu_limit",
            "within: 3s}\n    # the end of camera\n",
            "within: 3s}\n    cpu_limit: 7\n    # the end of camera\n",
        ),
        ("nodes detector stop within", "{cpu_limit: 1.0}", "{cpu_limit: 1.0, stop: {within: 7}}"),
        (
            "nodes idle cpu_limit",
            "  idle:   # nothing\n",
            "  idle:   # nothing\n    cpu_limit: 7\n",
        ),
        ("nodes plot cpu_limit", "    - /dev/b\n", "    - /dev/b\n    cpu_limit: 7\n"),
        (
            "nodes new stop within",
            "    - /dev/b\n",
            "    - /dev/b\n  new:\n    stop:\n      within: 7\n",
        ),
        ("cpu_limit", "    - /dev/b\n", "    - /dev/b\ncpu_limit: 7\n"),
    ],
)
def test_only_that_value_changes(place: str, before: str, after: str) -> None:
    assert FILE.count(before) == 1
    assert with_value(FILE, place.split(), "7") == FILE.replace(before, after)


@pytest.mark.parametrize(
    ("text", "after"),
    [
        ("", "nodes:\n  a:\n    x: 7\n"),
        ("# only\n", "# only\nnodes:\n  a:\n    x: 7\n"),
        ("nodes:", "nodes:\n  a:\n    x: 7\n"),
        ("nodes: {}", "nodes: {a: {x: 7}}"),
        ("nodes: { b: 1 }\n", "nodes: { b: 1, a: {x: 7} }\n"),
        ("nodes: {b: 1,}\n", "nodes: {b: 1, a: {x: 7}}\n"),
        ("---\nb: 1\n...\n", "---\nb: 1\nnodes:\n  a:\n    x: 7\n...\n"),
        ("nodes:\r\n  b: 1\r\n", "nodes:\r\n  b: 1\r\n  a:\r\n    x: 7\r\n"),
        ("ü: 'ä' # é\nnodes: {a: {é: ü, x: 1}}", "ü: 'ä' # é\nnodes: {a: {é: ü, x: 7}}"),
        ("nodes:\n  a:\n    y: |\n      text\n    z: 1", None),
    ],
)
def test_forms_of_a_file(text: str, after: str | None) -> None:
    expected = after or f"{text}\n    x: 7\n"
    assert with_value(text, ("nodes", "a", "x"), "7") == expected


@pytest.mark.parametrize(
    "text",
    [
        "- a\n",
        "nodes: ~\n",
        "nodes: 7\n",
        "nodes: [a]\n",
        "nodes: {a: }\n",
        "nodes:\n  a:\n    x: |\n      1\n",
        "nodes:\n  a:\n    x: 'one\n      two'\n",
        "nodes:\n  a:\n    x: [1]\n",
        "nodes:\n  a:\n    x:\n",
        "? nodes\n: 1\n",
    ],
)
def test_what_is_not_for_lines(text: str) -> None:
    assert with_value(text, ("nodes", "a", "x"), "7") is None


VALUES = st.recursive(
    st.sampled_from(["1", "'two'", '"three"', "4s", "# text"[2:], "50%"]),
    lambda inner: st.dictionaries(st.sampled_from("abcx"), inner, max_size=3),
    max_leaves=8,
)


def written(value: object, is_flow: bool, column: int = 0) -> str:
    if not isinstance(value, dict):
        return f" {value}"
    if is_flow or not value:
        inner = ", ".join(f"{key}:{written(one, True)}" for key, one in value.items())
        return f" {{{inner}}}"
    pad = "\n" + " " * column
    lines = (
        f"{pad}# c\n{pad}{key}:{written(one, False, column + 2)}" for key, one in value.items()
    )
    return "".join(lines)


@given(st.dictionaries(st.sampled_from("abcx"), VALUES, max_size=4), st.booleans(), st.data())
def test_every_change_is_only_that_change(
    document: dict[str, object], is_flow: bool, data: st.DataObject
) -> None:
    text = written(document, is_flow).lstrip(" ") + "\n"
    place = data.draw(st.lists(st.sampled_from("abcx"), min_size=1, max_size=3))
    after = with_value(text, place, "7s")
    if after is None:
        return
    before = parse_yaml(text, Path("x"), allow_empty=True) or {}
    assert parse_yaml(after, Path("x")) == put(before, place)
    assert text.count("# c") == after.count("# c")


def put(document: object, place: list[str]) -> object:
    if not place:
        return "7s"
    old = document if isinstance(document, dict) else {}
    return {**old, place[0]: put(old.get(place[0]), place[1:])}
