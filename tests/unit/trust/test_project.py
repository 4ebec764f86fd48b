"""The child that reads a project, and what is believed of it."""

import os
import signal
import subprocess
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust import courier
from dora_systemd.trust.project import Patience, Project, opened_project


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "dir").mkdir()
    (tmp_path / "dir/a.py").write_text("print()\n")
    (tmp_path / "link").symlink_to("dir/a.py")
    os.mkfifo(tmp_path / "fifo")
    return tmp_path


@pytest.fixture
def project(root: Path) -> Iterator[Project]:
    with opened_project(str(root), None) as found:
        yield found


def test_a_look(project: Project) -> None:
    kinds = {row[0]: row[1] for row in project.listed("", 10)}
    assert kinds == {"dir": "directory", "fifo": "FIFO", "link": "link"}
    (file, missing) = project.facts(["dir/a.py", "gone"])
    assert file is not None
    assert file[:5] == ["dir/a.py", "file", 8, False, ""]
    assert missing is None
    assert b"".join(project.read("dir/a.py")) == b"print()\n"
    assert len(project.listed("", 2)) == 2


@pytest.mark.parametrize("path", ["gone", "fifo", "link", "dir"])
def test_only_regular_files_are_read(project: Project, path: str) -> None:
    with pytest.raises(DoraSystemdError, match=f"cannot read .*{path} as user"):
        list(project.read(path))
    # The next answer is not disturbed.
    assert b"".join(project.read("dir/a.py")) == b"print()\n"


def test_a_large_file_comes_whole(root: Path, project: Project) -> None:
    data = os.urandom(1_000_000)
    (root / "large").write_bytes(data)
    assert b"".join(project.read("large")) == data


def test_without_git(project: Project) -> None:
    assert project.tracked([os.getuid()], 10) == (None, "")


def test_with_git(root: Path, project: Project) -> None:
    (root / ".gitignore").write_text("ignored\n")
    for name in ("ignored", "new\nline"):
        (root / name).write_text("")
    identity = ("-c", "user.name=a", "-c", "user.email=a@b")
    for words in (("init", "-q"), ("add", "dir"), (*identity, "commit", "-q", "-m", "x")):
        subprocess.run(["git", *words], cwd=root, check=True)
    files, revision = project.tracked([os.getuid()], 10)
    assert files == [".gitignore", "dir/a.py", "link", "new\nline"]
    assert len(revision) == 7
    (root / "dir/a.py").write_text("changed\n")
    assert project.tracked([os.getuid()], 10)[1] == f"{revision}+"


def test_git_prints_too_much() -> None:
    endless = subprocess.Popen(["yes"], stdout=subprocess.PIPE)
    with pytest.raises(OSError, match="too many"):
        courier.printed(endless, most=1000)
    assert endless.returncode == -signal.SIGKILL
    silent = subprocess.Popen(["sleep", "100"], stdout=subprocess.PIPE)
    assert courier.printed(silent, 0.05) is None


def test_a_git_above_that_ignores_all_of_it(root: Path) -> None:
    (root / ".gitignore").write_text("dir/\n")
    subprocess.run(["git", "init", "-q"], cwd=root, check=True)
    with opened_project(str(root / "dir"), None) as project:
        assert project.tracked([os.getuid()], 10) == (None, "")


def row(path: str = "a", size: int | str = 1) -> str:
    """Code that answers with a row."""
    return f"answer([{path!r}, 'file', {size}, False, '', 's', 1])"


LIARS = {
    "huge": row(size="2**63"),
    "no number": row(size="True"),
    "long": row(path="a" * 5000),
    "elsewhere": row(path="b/a"),
    "too many": "answer(*[[str(n), 'file', 1, False, '', 's', 1] for n in range(11)])",
    "silent": "",
    "no frame": "sys.stdout.write('hello, world')",
    "too long": "sys.stdout.write('+9999999')",
    "no JSON": r"sys.stdout.write('+0000002x\n.0000000')",
    "other JSON": r"sys.stdout.write('+0000005null\n.0000000')",
    "other rows": "answer([1, 2, 3, 4, 5])",
    "negative": row(size=-1),
    "no line": "sys.stdout.write('+0000001x.0000000')",
    "deep": "answer(eval('[' * 90 + ']' * 90))",
    "empty frames": "[sys.stdout.write('+0000000') for _ in range(5000)]",
    "endless": "while True: sys.stdout.write('+0262144' + ' ' * 262144)",
}


_ANSWER = """
import json, sys
def answer(*values):
    text = "".join(json.dumps(one) + "\\n" for one in values)
    sys.stdout.write(f"+{len(text):07d}{text}.0000000")
sys.stdin.readline()
"""


@contextmanager
def opened_liar(directory: Path, text: str) -> Iterator[Project]:
    """A project whose child takes a request and runs this code."""
    program = directory / "liar.py"
    program.write_text(f"{_ANSWER}{text}\nsys.stdout.flush()\n")
    with opened_project(str(directory), None, program=str(program)) as project:
        yield project


@pytest.mark.parametrize("lie", LIARS)
def test_a_child_that_lies(lie: str, tmp_path: Path) -> None:
    with (
        opened_liar(tmp_path, LIARS[lie]) as project,
        pytest.raises(DoraSystemdError, match="no answer"),
    ):
        project.listed("", 10)


@pytest.mark.parametrize("part", ["[],", "0,", '"ab",', "[]!"])
def test_a_child_that_lies_takes_no_memory(part: str, tmp_path: Path) -> None:
    """As JSON all of its 64 MiB would be more than 1 GB here."""
    text = (
        f"for _ in range(250): sys.stdout.write('+0262140' + '{part}' * (262140 // len('{part}')))"
    )
    tracemalloc.start()
    try:
        with opened_liar(tmp_path, text) as project:
            for use in (lambda: project.listed("", 9), lambda: project.tracked([1], 9)):
                with pytest.raises(DoraSystemdError, match="no answer"):
                    use()
        assert tracemalloc.get_traced_memory()[1] < 20 * 1024 * 1024
    finally:
        tracemalloc.stop()


def test_a_child_that_stops(project: Project) -> None:
    project.patience = Patience(most=0.1)
    os.kill(project._child.pid, signal.SIGSTOP)
    with pytest.raises(DoraSystemdError, match="no answer"):
        project.facts(["x" * 4000] * 100)  # more than a pipe holds


DRIBBLE = """
import time
while True:
    sys.stdout.write("+0000001x")
    sys.stdout.flush()
    time.sleep(0.01)
"""


def test_a_child_that_dribbles(tmp_path: Path) -> None:
    """Each frame comes in time, but the content would take for ever."""
    with (
        opened_liar(tmp_path, DRIBBLE) as project,
        pytest.raises(DoraSystemdError, match=r"cannot read .*/large .*: it takes too long"),
    ):
        project.patience = Patience(0.2)
        for at, _ in enumerate(project.read("large")):
            assert at < 500


def test_only_the_time_of_the_child_counts(root: Path, project: Project) -> None:
    (root / "large").write_bytes(bytes(4 * courier.CHUNK))
    before = project.patience.left
    for _ in project.read("large"):
        project.patience.left = 60.0
        time.sleep(0.01)
        assert project.patience.left == 60.0
    assert before == 300.0


def test_time_is_earned_by_bytes_and_files() -> None:
    patience = Patience()
    before = patience.left
    patience.earn(size=1024 * 1024, files=20)
    assert patience.left == before + 2.0 + 1.0


def test_an_answer_about_another_file(tmp_path: Path) -> None:
    with (
        opened_liar(tmp_path, row("b")) as project,
        pytest.raises(DoraSystemdError, match="no answer"),
    ):
        project.facts(["a"])


def test_the_file_that_failed_is_named(project: Project) -> None:
    long = "x" * 300
    with pytest.raises(DoraSystemdError, match=f"cannot read .*/{long} as user .*: File name too"):
        project.facts(["dir/a.py", long])


def test_a_walk_leaves_out_what_the_rules_say(root: Path, project: Project) -> None:
    def paths(directory: str) -> list[str]:
        return [row[0] for row in project.walked(directory, 10, ["*.pyc"])]

    (root / "dir/b.pyc").touch()
    assert paths("") == ["dir", "fifo", "link"]
    assert paths("dir") == ["dir/a.py"]
    (root / ".gitignore").write_text("[\n/link\ndir/*.txt\n")
    (root / "dir/.gitignore").write_text("/a.py\n")
    (root / "dir/c.txt").touch()
    assert paths("") == [".gitignore", "dir", "fifo"]
    assert paths("dir") == ["dir/.gitignore"]
    (root / "dir/.gitignore").unlink()
    assert paths("dir") == ["dir/a.py"]
    (root / ".gitignore").write_bytes(b"a" * (courier.MOST_RULES + 1))
    with pytest.raises(DoraSystemdError, match=r"\.gitignore as user .*: too large"):
        paths("")


def test_a_pattern_that_takes_for_ever_takes_none_of_our_time(root: Path, project: Project) -> None:
    (root / ("a" * 200)).touch()
    (root / ".gitignore").write_text("*a" * 40 + "b\n")
    project.patience = Patience(most=0.5)
    with pytest.raises(DoraSystemdError, match="no answer"):
        project.walked("", 10, [])
