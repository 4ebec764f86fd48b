"""What is refused of the child that reads a project, and in which words."""

import os
import time
from pathlib import Path

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust import courier
from dora_systemd.trust.paths import user_name
from dora_systemd.trust.project import Patience, opened_project
from tests.unit.trust.test_project import opened_liar, row

ME = user_name(os.geteuid())
HANGS = "see whether a mount of that user hangs"


def test_what_that_user_cannot_read(tmp_path: Path) -> None:
    with (
        opened_project(str(tmp_path), None) as project,
        pytest.raises(DoraSystemdError) as caught,
    ):
        list(project.read("gone"))
    reason = "No such file or directory"
    assert caught.value.message == f"cannot read {tmp_path}/gone as user {ME}: {reason}"
    assert caught.value.hint == "let that user read it, or name it in .gitignore"
    assert caught.value.code is ExitCode.BAD_INPUT


def test_a_project_that_is_not_there(tmp_path: Path) -> None:
    with (
        opened_project(f"{tmp_path}/gone", None) as project,
        pytest.raises(DoraSystemdError, match=r"/gone/a as user .*: No such file"),
    ):
        list(project.read("a"))


def test_no_answer_has_a_remedy(tmp_path: Path) -> None:
    with opened_liar(tmp_path, "") as project:
        with pytest.raises(DoraSystemdError) as caught:
            project.listed("", 10)
        assert caught.value.message == f"cannot read {tmp_path} as user {ME}: no answer"
        assert (caught.value.hint, caught.value.code) == (HANGS, ExitCode.FAILURE)
        project.patience = Patience(-1.0)
        with pytest.raises(DoraSystemdError) as caught:
            project.listed("dir", 10)
    assert caught.value.message == f"cannot read {tmp_path}/dir as user {ME}: it takes too long"
    assert (caught.value.hint, caught.value.code) == (HANGS, ExitCode.FAILURE)


def test_a_long_path_is_cut(tmp_path: Path) -> None:
    with opened_liar(tmp_path, "") as project, pytest.raises(DoraSystemdError) as caught:
        list(project.read("x" * 3000))
    assert len(caught.value.message) < 600


def test_a_reason_is_cut_and_shown_as_text(tmp_path: Path) -> None:
    text = "x" * 300
    reply = f"sys.stdout.write('-{len(text) + 4:07d}' + '\\x1b[2J' + '{text}')"
    with opened_liar(tmp_path, reply) as project, pytest.raises(DoraSystemdError) as caught:
        list(project.read("a"))
    assert "\x1b" not in caught.value.message
    assert caught.value.message.count("x") < 250


def test_only_a_file_that_was_asked_for_is_named(tmp_path: Path) -> None:
    """As the one that failed."""
    reply = "sys.stdout.write('-0000010no\\n/passwd')"
    with opened_liar(tmp_path, reply) as project:
        with pytest.raises(DoraSystemdError) as caught:
            project.facts(["a", "b"])
        assert caught.value.message == f"cannot read {tmp_path}/a as user {ME}: no"
    with (
        opened_liar(tmp_path, "sys.stdout.write('-0000004no\\nb')") as project,
        pytest.raises(DoraSystemdError) as caught,
    ):
        project.facts(["a", "b"])
    assert caught.value.message == f"cannot read {tmp_path}/b as user {ME}: no"


GOOD = "answer(*[['a', 'file', 1, False, '', 's', 1], None])"


@pytest.mark.parametrize(
    "lie",
    [
        "answer({})",
        "answer([])",
        "answer(None)",
        "answer(None, None, None)",
        "answer(False, None)",
        "answer(*[['b', 'file', 1, False, '', 's', 1], None])",
        "answer(*[['a', 'file', 1, False, '', 's'], None])",
        "answer(*[['a', 'file', 1, False, '', 's', 's'], None])",
        "answer(*[['a', 'file', '1', False, '', 's', 1], None])",
        "answer(*[['a', 'file', 1, 0, '', 's', 1], None])",
        "answer(*[['a', 'file', 1, False, '', None, 1], None])",
        "answer(*[['a', 'file', -1, False, '', 's', 1], None])",
        "answer(*[['a', 'file', 2**63, False, '', 's', 1], None])",
        "answer(*[['a', 'file', 1, False, 't' * 4097, 's', 1], None])",
        "answer('afile1', None)",
    ],
)
def test_facts_that_are_none(tmp_path: Path, lie: str) -> None:
    with (
        opened_liar(tmp_path, lie) as project,
        pytest.raises(DoraSystemdError, match=r"/a as user .*: no answer"),
    ):
        project.facts(["a", "b"])


def test_the_largest_facts_that_are_believed(tmp_path: Path) -> None:
    largest = f"answer(*[['a', 'file', 2**63 - 1, False, '{'t' * 4096}', 's', 1], None])"
    for text in (GOOD, largest, GOOD.replace("1,", "0,")):
        with opened_liar(tmp_path, text) as project:
            found, missing = project.facts(["a", "b"])
        assert found
        assert (found[0], missing) == ("a", None)


def test_many_files_are_asked_for_in_parts(tmp_path: Path) -> None:
    for name in ("0", "500", "1000"):
        (tmp_path / name).touch()
    with opened_project(str(tmp_path), None) as project:
        found = project.facts([str(number) for number in range(1001)])
    assert [n for n, one in enumerate(found) if one] == [0, 500, 1000]
    assert len(found) == 1001


@pytest.mark.parametrize(
    "lie",
    [
        "answer('r', 'a', 1)",
        "answer(7, 'a')",
        "answer(['r', 'a'])",
        "answer('r', 'a' * 4097)",
        "answer('r', *['a'] * 4)",
    ],
)
def test_files_of_git_that_are_none(tmp_path: Path, lie: str) -> None:
    with (
        opened_liar(tmp_path, lie) as project,
        pytest.raises(DoraSystemdError, match=r"/\.git as user .*: no answer"),
    ):
        project.tracked([1], 3)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("answer('7', *['a'] * 3)", (["a"] * 3, "7")),
        ("answer('')", ([], "")),
        ("sys.stdout.write('.0000000')", (None, "")),
    ],
)
def test_what_git_says(tmp_path: Path, text: str, found: tuple[list[str] | None, str]) -> None:
    with opened_liar(tmp_path, text) as project:
        assert project.tracked([1], 3) == found


@pytest.mark.parametrize(("size", "is_whole"), [(courier.CHUNK, True), (courier.CHUNK + 1, False)])
def test_the_longest_frame(tmp_path: Path, size: int, is_whole: bool) -> None:
    reply = f"sys.stdout.write('+{size:07d}' + 'x' * {size} + '.0000000')"
    with opened_liar(tmp_path, reply) as project:
        if is_whole:
            assert b"".join(project.read("a")) == b"x" * size
        else:
            with pytest.raises(DoraSystemdError, match="no answer"):
                list(project.read("a"))


def test_a_directory_has_its_own_entries(tmp_path: Path) -> None:
    with opened_liar(tmp_path, row("dir/a")) as project:
        assert project.listed("dir", 1)[0][0] == "dir/a"
    with (
        opened_liar(tmp_path, row("dir/b/a")) as project,
        pytest.raises(DoraSystemdError, match=r"/dir as user .*: no answer"),
    ):
        project.listed("dir", 1)


def test_a_frame_may_take_its_time_but_not_more_than_all_together() -> None:
    begun = time.monotonic()
    with Patience(left=900.0, most=300.0).waiting() as deadline:
        assert 300 <= deadline - begun < 600
    with Patience(left=300.0, most=900.0).waiting() as deadline:
        assert 300 <= deadline - begun < 600
    patience = Patience(left=0.0)
    with pytest.raises(BrokenPipeError), patience.waiting():
        pass
    assert patience.left == 0.0
