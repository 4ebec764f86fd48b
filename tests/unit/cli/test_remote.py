"""doractl -H with an ssh that runs the command right here, in a shell that prints before."""

import json
import os
import subprocess
import sys
from pathlib import Path

import click
import pytest

from dora_systemd.cli import main
from dora_systemd.cli.group import VERBS, doractl
from dora_systemd.cli.remote.dispatch import valued_options
from dora_systemd.cli.remote.printers import Complaints
from dora_systemd.decisions.remote.hosts import parse_host
from dora_systemd.errors import ExitCode
from dora_systemd.verbs.remote import talk
from tests.unit.fakes.programs import make_program

SSH = """for command; do :; done
while [ "$1" != -- ]; do shift; done
case $2 in
    dead) echo "ssh: connect to host dead port 22: Connection refused" >&2; exit 255;;
    mute) exec sleep 1000;;
esac
echo "welcome to $2"; echo "be careful" >&2
HOST=$2; export HOST
exec sh -c "$command"
"""
DORACTL = """echo "$HOST $*" >>"$0.asked"
case " $* " in
    *" -o json "*) echo '[{"schema": 1, "name": "'"$HOST"'"}]';;
    *" enable "*) printf 'first\\nlast'; echo "doractl: be quick" >&2;;
    *" why "*) echo "all about $2 on $HOST"; sleep 0.$((${#HOST} % 2));;
    *" stop "*) echo "doractl: no dataflow" >&2; echo "hint: look" >&2; exit 4;;
    *" logs "*)
        printf '__REALTIME_TIMESTAMP=%d\\nSYSLOG_IDENTIFIER=robot/cam\\nMESSAGE=%s\\n\\n' \\
            "${HOST#h}" one "1${HOST#h}" two;;
    *" list "*) echo garbage;;
esac
"""


@pytest.fixture(autouse=True)
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What was asked of doractl, by host."""
    make_program(tmp_path / "ssh", SSH)
    make_program(tmp_path / "doractl", DORACTL)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    return tmp_path / "doractl.asked"


Printed = pytest.CaptureFixture[str]


def test_one_host_is_as_it_is_there(capsys: Printed, programs: Path) -> None:
    assert main.run(["-H", "h1", "--user", "stop", "x'y\\z *", "-f"]) == 4
    assert capsys.readouterr() == ("", "doractl: no dataflow\nhint: look\n")
    assert main.run(["why", "robot", "-H", "h1"]) == 0
    assert capsys.readouterr() == ("all about robot on h1\n", "")
    assert programs.read_text() == "h1 --user stop x'y\\z * -f\nh1 why robot\n"


def test_several_hosts(capsys: Printed) -> None:
    assert main.run(["why", "robot", "-H", "h1,h22,dead"]) == ExitCode.NO_HOST
    out, err = capsys.readouterr()
    assert out == "==> h1 <==\nall about robot on h1\n\n==> h22 <==\nall about robot on h22\n"
    assert err == (
        "doractl: cannot reach dead: connect to host dead port 22: Connection refused\n"
        "hint: start sshd there, or give its port: dead:PORT\n"
    )
    assert main.run(["-H", "h1,h2", "stop", "robot"]) == 4
    out, err = capsys.readouterr()
    lines = sorted(err.splitlines())
    assert (out, lines[:2]) == ("", ["doractl: h1: no dataflow", "doractl: h2: no dataflow"])
    assert lines[2:] == ["h1: hint: look", "h2: hint: look"]
    assert main.run(["-H", "h1", "-H", "h1,h2", "enable", "robot"]) == 0
    out, err = capsys.readouterr()
    assert sorted(out.splitlines()) == ["h1: first", "h1: last", "h2: first", "h2: last"]
    assert sorted(err.splitlines()) == ["doractl: h1: be quick", "doractl: h2: be quick"]


def test_objects(capsys: Printed) -> None:
    assert main.run(["show", "x", "-o", "json", "-H", "h1,dead,h2"]) == ExitCode.NO_HOST
    out, err = capsys.readouterr()
    assert [list(one.values()) for one in json.loads(out)] == [[1, "h1", "h1"], [1, "h2", "h2"]]
    problem = json.loads(err)
    assert list(problem) == ["schema", "host", "error"]
    assert (problem["host"], problem["error"]["exit_status"]) == ("dead", ExitCode.NO_HOST)


def test_hosts_without_a_dataflow(capsys: Printed) -> None:
    make_program(Path(os.environ["PATH"].partition(":")[0]) / "doractl", "echo '[]'")
    assert main.run(["list", "-H", "h1,h2"]) == 0
    assert capsys.readouterr() == ("No dataflow is running.\n", "")
    assert main.run(["list", "-H", "h1,dead", "--all"]) == ExitCode.NO_HOST
    out, err = capsys.readouterr()
    assert [line.split()[0] for line in out.splitlines()] == ["HOST", "dead"]
    assert len(err.splitlines()) == 2


def test_merged_logs(capsys: Printed) -> None:
    assert main.run(["logs", "robot", "-H", "h2,h1"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    found = [(words[0], words[-1]) for words in lines]
    assert found == [("h1", "one"), ("h2", "one"), ("h1", "two"), ("h2", "two")]
    assert main.run(["logs", "robot", "-o", "cat", "-r", "-H", "h1,h2"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert len(lines) == 4
    assert main.run(["logs", "-o", "export", "-H", "h1,h2"]) == ExitCode.USAGE
    assert "cannot merge -o export" in capsys.readouterr().err


def test_a_pattern_need_not_match_on_all_hosts(capsys: Printed) -> None:
    """logs --grep has exit status 1 where nothing matches."""
    found = """case "$HOST" in quiet*) exit 1;; broken) exit 4;; esac"""
    make_program(Path(os.environ["PATH"].partition(":")[0]) / "doractl", found)
    for hosts, status in (("h1,quiet", 0), ("quiet,quiet2", 1), ("h1,quiet,broken", 4)):
        assert main.run(["logs", "robot", "--grep", "x", "-H", hosts]) == status
    assert main.run(["logs", "robot", "-H", "h1,quiet"]) == 1
    capsys.readouterr()


def test_what_was_read_can_be_printed(capsys: Printed) -> None:
    for depth in (98, 99, 100, 950, 5000, 1_000_000):
        line = b'{"x":' + b"[" * depth + b"]" * depth + b"}\n"
        Complaints(is_json=True).said(parse_host("base"), line)
    lines = capsys.readouterr().err.splitlines()
    assert ["warning" in json.loads(line) for line in lines] == [False] * 2 + [True] * 4


def test_an_answer_that_is_none(capsys: Printed) -> None:
    make_program(Path(os.environ["PATH"].partition(":")[0]) / "doractl", "echo garbage")
    for line in ("list", "list -o json", "stop -a -o json", "logs robot", "logs robot -o json"):
        assert main.run([*line.split(), "-H", "h1,h2"]) == ExitCode.NO_HOST
        err = capsys.readouterr().err
        assert err.count("cannot read the answer of h") == 2
        assert "Traceback" not in err


@pytest.mark.parametrize("hosts", ["mute", "mute,h1"])
def test_a_login_has_a_bound(hosts: str, capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(talk, "LOGIN_SECONDS", 0.5)
    assert main.run(["version", "-H", hosts]) == ExitCode.NO_HOST
    assert "doractl: cannot reach mute: no login within 0.5s\n" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("env -H h1", "cannot use env with -H"),
        ("run x.yml -H h1,h2", "cannot run on several hosts"),
        ("dora robot -H h1,h2", "cannot dora on several hosts"),
        ("start x.yml --attach -H h1,h2", "cannot start on several hosts"),
        ("list --oll -H h1", "unknown option --oll"),
        ("strat -H h1", "unknown command 'strat'"),
        ("machine add -H h1", "missing argument 'host'"),
        ("list -H h1,", "cannot use '' as a host"),
        ("list -H -oX", "cannot use '-oX' as a host"),
        ("list -H", "option -H requires a host"),
    ],
)
def test_wrong_command_lines(words: str, message: str, capsys: Printed, programs: Path) -> None:
    """They are found here, before any host hears of them."""
    assert main.run(words.split()) == ExitCode.USAGE
    out, err = capsys.readouterr()
    assert (out, len(err.splitlines())) == ("", 2)
    assert err.lower().startswith(f"doractl: {message.lower()}")
    assert not programs.exists()


def test_a_command_of_another_tool_is_meant_there(capsys: Printed, programs: Path) -> None:
    del programs
    main.run(["-H", "h1", "rm", "x", "--host=h2"])
    assert "did you mean doractl -H h1,h2 stop?" in capsys.readouterr().err
    main.run(["-H", "h1", "node", "list"])
    assert "did you mean doractl -H h1 list NAME?" in capsys.readouterr().err


def test_the_host_knows_which_names_can_be_missing(capsys: Printed, programs: Path) -> None:
    for words in ("restart", "set", "node stop", "rollback"):
        main.run([*words.split(), "-H", "h1"])
        assert programs.read_text() == f"h1 {words}\n"
        programs.unlink()
    main.run(["set", "-H", "h1", "--help"])
    assert "Usage: doractl set [OPTIONS] SELECTOR\n" in capsys.readouterr().out


def test_help_is_ours(capsys: Printed, programs: Path) -> None:
    assert main.run(["-H", "h1", "list", "--help"]) == 0
    assert "-H, --host" in capsys.readouterr().out
    assert main.run(["-H", "h1"]) == 0
    assert "Usage: doractl" in capsys.readouterr().out
    assert not programs.exists()


def test_all_hosts(capsys: Printed, tmp_path: Path) -> None:
    assert main.run(["-H", "all", "version"]) == ExitCode.BAD_INPUT
    assert "cannot use all hosts: there is no " in capsys.readouterr().err
    hosts = tmp_path / "home/.config/dora-systemd/hosts"
    hosts.parent.mkdir(parents=True)
    hosts.write_text("# none\n")
    assert main.run(["-H", "all", "version"]) == ExitCode.BAD_INPUT
    assert "names no host" in capsys.readouterr().err


def test_without_ssh(capsys: Printed, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path / "home"))
    for hosts in ("h1", "h1,h2"):
        assert main.run(["version", "-H", hosts]) == ExitCode.NO_HOST
        assert "doractl: cannot execute ssh: No such file" in capsys.readouterr().err


def test_a_file_that_the_host_refuses(
    capsys: Printed, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    make_program(Path(os.environ["PATH"].partition(":")[0]) / "doractl", "exit 5")
    monkeypatch.chdir(tmp_path)
    here = tmp_path / "here.yml"
    here.touch()
    begins, copies = "begins in the home directory there", "doractl deploy copies it"
    hints = {"x.yml": [begins], "here.yml": [begins, copies], str(here): [copies]}
    for words, expected in {**hints, "/x.yml": [], "robot": []}.items():
        for verb in ("start", "build"):
            assert main.run([verb, words, "-H", "h1"]) == ExitCode.BAD_INPUT
            said = capsys.readouterr().err
            assert ("hint: FILE is a path on h1" in said) == bool(expected)
            assert [one for one in (begins, copies) if one in said] == expected


def test_no_verb_takes_a_host_itself() -> None:
    """It would act on this machine."""
    with pytest.raises(click.UsageError, match="cannot use"):
        doractl.main(["list", "-H", "h1"], standalone_mode=False)


@pytest.mark.parametrize("verb", VERBS)
def test_options_with_a_value(verb: str) -> None:
    """As click counts words."""
    valued = valued_options(verb)
    assert {"-H", "--host"} <= valued
    assert not {"--user", "--all", "--force", "-b", "--boot"} & valued


def test_nothing_of_it_is_loaded_without_a_host() -> None:
    script = (
        "import sys\nfrom dora_systemd.cli import main\n"
        "for words in (['--help'], ['stop', '--help'], ['list', '--nothing']): main.run(words)\n"
        "print('loaded:', *[name for name in sys.modules if 'remote' in name or 'ssh' in name])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "loaded:"


def test_a_doractl_that_hangs_there(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    """It holds back neither the rows of the others nor, for ever, their lines."""
    place = Path(os.environ["PATH"].partition(":")[0])
    answer = 'case "$*" in *logs*) ;; *) echo "[]";; esac'
    make_program(place / "doractl", f'[ "$HOST" = h1 ] && exec sleep 1000\n{answer}')
    monkeypatch.setattr("dora_systemd.cli.remote.plan.SHORT_SECONDS", 0.5)
    monkeypatch.setattr("dora_systemd.cli.remote.plan.ANSWER_SECONDS", 0.5)
    for words in (["list"], ["logs", "robot"], ["releases"]):
        assert main.run([*words, "-H", "h1,h2"]) == ExitCode.NO_HOST
        out, err = capsys.readouterr()
        assert err.startswith("doractl: cannot reach h1: no answer within 0.5s\n")
        if words != ["logs", "robot"]:
            rows = [line.split() for line in out.splitlines()[1:]]
            assert [row[0] for row in rows] == ["h1"]
            assert "Unreachable" in rows[0]


def test_a_host_that_refuses_is_not_unreachable(capsys: Printed) -> None:
    place = Path(os.environ["PATH"].partition(":")[0])
    make_program(place / "doractl", 'echo "doractl: no release" >&2; exit 4')
    assert main.run(["releases", "robot", "-H", "h1,h2"]) == ExitCode.NOT_FOUND
    out, err = capsys.readouterr()
    assert "Unreachable" not in out
    assert sorted(err.splitlines()) == ["doractl: h1: no release", "doractl: h2: no release"]


def test_logs_follow_a_host_again_that_is_back(
    capsys: Printed, programs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = Path(os.environ["PATH"].partition(":")[0])
    record = "printf '__REALTIME_TIMESTAMP=%d\\nSYSLOG_IDENTIFIER=robot/cam\\nMESSAGE=%s\\n\\n'"
    make_program(
        place / "doractl",
        f"""echo "$*" >>"$0.asked"
[ "$HOST" = h2 ] && {{ {record} 5 other; exit 0; }}
[ -e "$0.lost" ] && {{ {record} 7000002 two; exit 0; }}
touch "$0.lost"; {record} 7000001 one; exit 255""",
    )
    monkeypatch.setattr(talk, "AGAIN_SECONDS", 0.1)
    assert main.run(["logs", "robot", "-f", "-n", "3", "-H", "h1,h2"]) == ExitCode.NO_HOST
    out, err = capsys.readouterr()
    assert sorted(line.split()[-1] for line in out.splitlines()) == ["one", "other", "two"]
    assert err.startswith("doractl: the connection to h1 is lost")
    again = programs.read_text().splitlines()[-1]
    assert again.endswith("--since=@7.000002 -n all")


def test_a_host_that_is_lost_after_ctrl_c_is_not_followed_again(programs: Path) -> None:
    place = Path(os.environ["PATH"].partition(":")[0])
    make_program(
        place / "doractl",
        f"""echo "$HOST" >>"$0.asked"
trap 'exit 255' TERM
[ "$HOST" = h2 ] || kill -INT {os.getpid()}
while :; do sleep 0.1; done""",
    )
    assert main.run(["logs", "robot", "-f", "-H", "h1,h2"]) == ExitCode.INTERRUPTED
    assert programs.read_text().count("h1\n") == 1
