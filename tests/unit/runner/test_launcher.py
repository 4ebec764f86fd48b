"""launcher.pl and what stands in for python and uv: real scripts, with a pretended cgroup."""

import ast
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import dora_systemd
from dora_systemd.runner.cell.begin import SIGACTION
from tests.unit.fakes.programs import make_program

PACKAGE = Path(dora_systemd.__file__).parent
LIBEXEC = str(PACKAGE / "libexec")


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """What the runner gives the daemon, for a cell with the nodes `one` and `kept`."""
    for part in ("io", "node-one", "node-kept", "project"):
        (tmp_path / part).mkdir()
    return {
        "PATH": f"{LIBEXEC}:/usr/bin:/bin",
        "DORA_QUIET": "1",
        "RUST_BACKTRACE": "0",
        "MODEL": "yolo",
        "DORA_SYSTEMD_UNSET": "DORA_QUIET RUST_BACKTRACE",
        "DORA_SYSTEMD_CELL": str(tmp_path),
        "DORA_SYSTEMD_GROUP": str(tmp_path),
        "DORA_SYSTEMD_LIBEXEC": LIBEXEC,
        "DORA_SYSTEMD_DIRECTORY": str(tmp_path / "project"),
        "DORA_SYSTEMD_PYTHON": "/bin/echo",
    }


def launch(environment: dict[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        words, env=environment, capture_output=True, text=True, check=False, timeout=120
    )


def launcher(environment: dict[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    return launch(environment, "/usr/bin/perl", str(PACKAGE / "launcher.pl"), *words)


def test_the_node_gets_group_pipes_directory_and_environment(
    environment: dict[str, str], tmp_path: Path
) -> None:
    script = "echo $$ $PWD; echo warn >&2; env"
    done = launcher(environment, "one", str(tmp_path / "project"), "pipe", "/bin/sh", "-c", script)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    said = (tmp_path / "io/one.out").read_text().splitlines()
    pid = (tmp_path / "io/one.pid").read_text().strip()
    assert said[0] == f"{pid} {tmp_path / 'project'}"
    assert (tmp_path / "io/one.err").read_text() == "warn\n"
    assert (tmp_path / "node-one/cgroup.procs").read_text() == "0\n"
    assert "MODEL=yolo" in said
    assert "PATH=/usr/bin:/bin" in said
    left = [line for line in said if line.startswith(("DORA_", "RUST_"))]
    assert left == [f"DORA_ZENOH_CONFIG_OVERLAY={PACKAGE}/zenoh.json5"]


def test_the_node_ignores_no_signal_of_glibc(environment: dict[str, str], tmp_path: Path) -> None:
    """As posix_spawn(3) of dora's daemon makes it, without clone3(2)."""
    number = SIGACTION["DORA_SYSTEMD_SIGACTION"]
    ignore = f"syscall({number}, $_, my $act = pack('Q4', 1, 0, 0, 0), 0, 8)"
    run = f"{ignore} for 32, 33; exec @ARGV"
    words = ("one", str(tmp_path), "keep", "/bin/grep", "SigIgn", "/proc/self/status")
    begin = ("/usr/bin/perl", "-e", run)
    before = launch(environment, *begin, *words[3:]).stdout.split()[1]
    own = {**environment, **SIGACTION}
    done = launch(own, *begin, "/usr/bin/perl", str(PACKAGE / "launcher.pl"), *words)
    after = done.stdout.split()[1]
    assert (int(before, 16) >> 31, int(after, 16) >> 31) == (3, 0)
    assert done.stderr == ""


def test_the_node_is_in_its_group_while_it_waits_for_its_pipes(
    environment: dict[str, str], tmp_path: Path
) -> None:
    os.mkfifo(tmp_path / "io/one.out")
    command = ("/usr/bin/perl", str(PACKAGE / "launcher.pl"), "one", str(tmp_path), "pipe", "true")
    group = tmp_path / "node-one/cgroup.procs"
    with subprocess.Popen(command, env=environment) as waiting:
        deadline = time.monotonic() + 60
        while not group.exists() and time.monotonic() < deadline:
            time.sleep(0.001)
        assert group.exists()
        assert waiting.poll() is None
        (tmp_path / "io/one.out").read_bytes()
        assert waiting.wait(60) == 0


RIGHTS = "one.x /bin/false\none /usr/bin/nice -n 3 /usr/bin/chrt --batch 0\n* /usr/bin/nice -n 5\n"


@pytest.mark.parametrize(("node", "nice"), [("one", 3), ("kept", 5)])
def test_rights_of_the_node_and_of_all_others(
    environment: dict[str, str], tmp_path: Path, node: str, nice: int
) -> None:
    base = os.getpriority(os.PRIO_PROCESS, 0)
    words = (node, str(tmp_path), "keep", "/bin/sh", "-c", "nice; env")
    done = launcher({**environment, "DORA_SYSTEMD_RIGHTS": RIGHTS}, *words)
    assert (done.returncode, done.stderr) == (0, "")
    first, *variables = done.stdout.splitlines()
    assert int(first) == min(base + nice, 19)
    assert not [line for line in variables if line.startswith("DORA_SYSTEMD")]


ODD = {
    **{"node": "camera", "directory": "/d", "output": "o", "last": "l", "IFS": "x", "OPTIND": "7"},
    **{"my.var": "1", "MY-VAR": "2", "a b": "3", "OLDPWD": "/old", "PWD": "/here", "_": "me"},
    **{"LC_ALL": "xx_YY", "LINES": "a\nb", "UTF": "ü", "EMPTY": "", "PERL5LIB": "/nowhere"},
}


def test_no_other_variable_is_touched(environment: dict[str, str], tmp_path: Path) -> None:
    environment |= {**ODD, "PERL_BADLANG": "0", "ZENOH_CONFIG": "z"}
    environment["DORA_SYSTEMD_UNSET"] += " PERL_BADLANG"
    script = "import posix; print({k.decode(): v.decode() for k, v in posix.environ.items()})"
    words = ("/usr/bin/python3", "-I", "-S", "-c", script)
    done = launcher(environment, "kept", str(tmp_path), "keep", *words)
    assert done.stderr == ""
    given = {key: text for key, text in environment.items() if key in ODD}
    assert ast.literal_eval(done.stdout) == {
        **given,
        "PATH": "/usr/bin:/bin",
        "MODEL": "yolo",
        "ZENOH_CONFIG": "z",
        "PYTHONFAULTHANDLER": "1",
    }


NOTIFY = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")


@pytest.mark.parametrize(
    ("output", "expected"),
    [
        ("keep", {"WATCHDOG_USEC": "old"}),
        ("keep:0", {"NOTIFY_SOCKET": "io/kept.notify"}),
        ("keep:5", {"NOTIFY_SOCKET": "io/kept.notify", "WATCHDOG_USEC": "5", "WATCHDOG_PID": "$"}),
        ("keep:5:any", {"NOTIFY_SOCKET": "io/kept.notify", "WATCHDOG_USEC": "5"}),
    ],
)
def test_the_notify_socket(
    environment: dict[str, str], tmp_path: Path, output: str, expected: dict[str, str]
) -> None:
    environment["WATCHDOG_USEC"] = "old"
    script = "echo pid=$$; env"
    done = launcher(environment, "kept", str(tmp_path), output, "/bin/sh", "-c", script)
    said = dict(line.split("=", 1) for line in done.stdout.splitlines() if "=" in line)
    texts = {key: said[key].replace(f"{tmp_path}/", "") for key in NOTIFY if key in said}
    assert {key: "$" if text == said["pid"] else text for key, text in texts.items()} == expected


def test_signals_are_as_they_were(environment: dict[str, str], tmp_path: Path) -> None:
    words = ("/usr/bin/grep", "Sig[^Q]", "/proc/self/status")  # SigQ counts those of all
    here = launch(environment, *words).stdout
    assert launcher(environment, "kept", str(tmp_path), "keep", *words).stdout == here


@pytest.mark.parametrize("key", ["ZENOH_CONFIG", "DORA_ZENOH_CONFIG_OVERLAY"])
@pytest.mark.parametrize("text", ["/etc/own.json5", ""])
def test_zenoh_of_ones_own(
    environment: dict[str, str], tmp_path: Path, key: str, text: str
) -> None:
    done = launcher({**environment, key: text}, "kept", str(tmp_path), "keep", "/usr/bin/env")
    said = done.stdout.splitlines()
    assert [one for one in said if one.startswith(("DORA_Z", "ZENOH_"))] == [f"{key}={text}"]


@pytest.mark.parametrize("own", [None, "", "0"])
def test_python_prints_its_stack(
    environment: dict[str, str], tmp_path: Path, own: str | None
) -> None:
    given = environment if own is None else {**environment, "PYTHONFAULTHANDLER": own}
    crash = ("-c", "import os\ndef read_frame():\n  os.abort()\nread_frame()")
    done = launcher(given, "kept", str(tmp_path), "keep", sys.executable, *crash)
    assert done.returncode == -signal.SIGABRT
    assert ("in read_frame" in done.stderr) == (own != "")


def test_output_that_dora_reads_is_left_alone(environment: dict[str, str], tmp_path: Path) -> None:
    done = launcher(environment, "kept", str(tmp_path), "keep", "/bin/echo", "a b", "$x")
    assert done.stdout == "a b $x\n"
    assert not (tmp_path / "io/kept.out").exists()


def test_a_command_that_is_not_there_says_so_in_the_nodes_own_log(
    environment: dict[str, str], tmp_path: Path
) -> None:
    done = launcher(environment, "one", str(tmp_path), "pipe", "/nonexistent")
    assert done.returncode == 127
    assert "/nonexistent" in (tmp_path / "io/one.err").read_text()


def test_a_directory_that_is_gone_and_a_group_that_is_gone(
    environment: dict[str, str], tmp_path: Path
) -> None:
    assert launcher(environment, "one", "/nonexistent", "pipe", "true").returncode != 0
    done = launcher(environment, "unknown", str(tmp_path), "keep", "/bin/echo", "ran")
    assert done.returncode != 0
    assert "ran" not in done.stdout


@pytest.mark.parametrize("node", ["one", "kept"])
def test_operators_are_recognised(environment: dict[str, str], tmp_path: Path, node: str) -> None:
    os.mkfifo(tmp_path / "io/one.out")
    pipe = os.open(tmp_path / "io/one.out", os.O_RDWR)
    words = ("-uc", f"import dora; dora.start_runtime() # {node}")
    done = launch(environment, f"{LIBEXEC}/python", *words)
    output = done.stdout if node == "kept" else os.read(pipe, 1000).decode()
    os.close(pipe)
    assert output == " ".join(words) + "\n"
    assert (tmp_path / f"node-{node}/cgroup.procs").exists()


def test_other_uses_of_python_go_to_the_real_one(environment: dict[str, str]) -> None:
    assert launch(environment, f"{LIBEXEC}/python", "-c", "x").stdout == "-c x\n"
    assert launch(environment, f"{LIBEXEC}/python").stdout == "\n"


def test_uv_finds_our_python_and_is_uv_otherwise(
    environment: dict[str, str], tmp_path: Path
) -> None:
    make_program(tmp_path / "uv", 'echo real "$@"')
    environment["PATH"] = f"{LIBEXEC}:{tmp_path}:/usr/bin:/bin"
    assert launch(environment, f"{LIBEXEC}/uv", "python", "find").stdout == f"{LIBEXEC}/python\n"
    assert launch(environment, f"{LIBEXEC}/uv", "run", "x").stdout == "real run x\n"


def test_the_scripts_are_executable() -> None:
    for name in ("python", "uv"):
        assert os.access(f"{LIBEXEC}/{name}", os.X_OK)
