"""deploy -H with an ssh that runs the command right here: the order of hosts, and when it stops."""

import json
import os
import pwd
from pathlib import Path
from typing import NoReturn

import pytest

from dora_systemd.cli import main
from dora_systemd.cli.remote import rollout
from dora_systemd.decisions.releases.parcel import parse_parcel
from dora_systemd.errors import ExitCode
from tests.lab.pace import bound
from tests.unit.fakes.programs import make_program

SSH = """for command; do :; done
while [ "$1" != -- ]; do shift; done
case $2 in
    dead) echo "ssh: connect to host dead port 22: Connection refused" >&2; exit 255;;
esac
echo "welcome"
HOST=$2; export HOST
exec sh -c "$command"
"""
DORACTL = """echo "$HOST $*" >>"$0.asked"
case $HOST in
    mad) echo '{"wants": [7]}'; cat >/dev/null;;
esac
case " $* " in *" rollback "*) ;; *)
    read -r head; printf '%s\\n' "$head" >"$0.head"
    case " $* " in *" --dry-run "*) echo "~ a.py on $HOST"; exit;; esac
    echo '{"wants": [0]}'
    head -c 5 >"$0.content-$HOST";;
esac
case $HOST in
    cut) echo '{"progress": {"stage": "soak"}}' >&2; exit 255;;
    lost) echo "client_loop: send disconnect: Broken pipe" >&2; exit 255;;
    mute) exec sleep 600;;
    same) echo '{"schema": 1, "action": "deploy", "name": "robot", "result": "unchanged",'
          echo '"details": {"release": "20261121T220012", "former": null}}'; exit 0;;
    slow) for one in 1 2 3 4; do echo '{"progress": {"stage": "build"}}' >&2; sleep 0.5; done;;
    busy) echo '{"error": {"message": "busy", "exit_status": 10}}' >&2; exit 10;;
    bad*) echo '{"error": {"message": "was rolled back: a", "exit_status": 11}}' >&2; exit 11;;
esac
echo '{"schema": 1, "action": "deploy", "name": "robot", "result": "done",'
echo '"details": {"release": "20261121T220012", "former": null}}'
"""


def getpwnam(name: str) -> NoReturn:
    raise KeyError(name)


@pytest.fixture(autouse=True)
def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What was asked of doractl, by host."""
    make_program(tmp_path / "bin/ssh", SSH)
    make_program(tmp_path / "bin/doractl", DORACTL)
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:{os.environ['PATH']}")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    # Where that user exists, it reads the project for root, and cannot read this one.
    monkeypatch.setattr(pwd, "getpwnam", getpwnam)
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot/a.py").write_text("print")
    (tmp_path / "robot/dataflow.yml").write_text("nodes: [{id: a, path: a.py}]\n")
    monkeypatch.chdir(tmp_path / "robot")
    return tmp_path / "bin/doractl.asked"


Printed = pytest.CaptureFixture[str]


def table(capsys: Printed) -> tuple[list[list[str]], str]:
    """The rows of the table, and the other stream."""
    out, err = capsys.readouterr()
    header, *lines = out.splitlines()
    assert header.split() == ["HOST", "RESULT", "RELEASE", "BEFORE"]
    return [line.split() for line in lines], err


def test_each_host_gets_what_it_asks_for(capsys: Printed, asked: Path) -> None:
    assert main.run(["deploy", "-H", "h1,dead,h2", "--memory-limit", "1G"]) == ExitCode.NO_HOST
    rows, err = table(capsys)
    assert rows == [
        ["h1", "deployed", "20261121T220012", "-"],
        ["dead", "unreachable", "-", "-"],
        ["h2", "deployed", "20261121T220012", "-"],
    ]
    assert err.startswith("doractl: cannot reach dead: connect to host dead")
    assert asked.read_text().splitlines() == [
        f"{host} deploy --memory-limit 1G --from-stdin -o json" for host in ("h1", "h2")
    ]
    for host in ("h1", "h2"):
        assert asked.with_name(f"doractl.content-{host}").read_text() == "print"
    parcel = parse_parcel(asked.with_name("doractl.head").read_bytes())
    assert (parcel.name, parcel.dataflow, parcel.directory) == ("robot", "dataflow.yml", None)
    assert set(parcel.files) == {"a.py", "dataflow.yml"}


def test_a_host_where_that_release_runs_holds_up_nobody(capsys: Printed) -> None:
    assert main.run(["deploy", "-H", "same,h2"]) == ExitCode.OK
    rows, _ = table(capsys)
    assert [row[:2] for row in rows] == [["same", "unchanged"], ["h2", "deployed"]]


@pytest.mark.parametrize(
    ("host", "words", "status"),
    [
        ("bad", ["rolled", "back"], ExitCode.ROLLED_BACK),
        ("mad", ["lost"], ExitCode.NO_HOST),
        ("lost", ["lost"], ExitCode.NO_HOST),
        ("cut", ["lost"], ExitCode.NO_HOST),
    ],
)
def test_it_stops(host: str, words: list[str], status: int, capsys: Printed, asked: Path) -> None:
    assert main.run(["deploy", "-H", f"dead,busy,{host},h2"]) == status
    rows, err = table(capsys)
    assert [row[1 : 1 + len(words)] for row in rows[2:3]] == [words]
    assert [row[:2] for row in (rows[0], rows[1])] == [
        ["dead", "unreachable"],
        ["busy", "inhibited"],
    ]
    assert rows[3][:3] == ["h2", "not", "tried"]
    assert host in err
    assert "{" not in err
    assert "h2" not in asked.read_text()


@pytest.mark.parametrize("verb", [["deploy"], ["rollback", "robot"]])
def test_a_host_that_falls_silent(
    verb: list[str], capsys: Printed, asked: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that tells what it does may take any time."""
    monkeypatch.setattr(rollout, "SILENCE_SECONDS", bound(1.2))
    assert main.run([*verb, "-H", "slow,mute,h2", "-q"]) == ExitCode.NO_HOST
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("doractl: the connection to mute is lost: no word for ")
    assert "slow" not in err
    assert [line.split()[0] for line in asked.read_text().splitlines()] == ["slow", "mute"]
    assert not any("-q" in line.split() for line in asked.read_text().splitlines())


def test_quiet_is_quiet_for_programs_too(capsys: Printed) -> None:
    assert main.run(["rollback", "robot", "-H", "slow,bad", "-qo", "json"]) == 11
    out, err = capsys.readouterr()
    assert out == ""
    assert [json.loads(line)["host"] for line in err.splitlines()] == ["bad"]


def test_some_at_a_time(capsys: Printed, asked: Path) -> None:
    """What has begun goes on, and what waits does not begin."""
    hosts = "bad1,bad2,h1"
    assert main.run(["deploy", "-H", hosts, "--serial", "2", "-o", "json"]) == ExitCode.ROLLED_BACK
    found = {one["host"]: one for one in map(json.loads, capsys.readouterr().out.splitlines())}
    assert {host: one["result"] for host, one in found.items()} == {
        "bad1": "rolled back",
        "bad2": "rolled back",
        "h1": "not tried",
    }
    assert found["bad1"]["error"]["exit_status"] == ExitCode.ROLLED_BACK
    assert found["h1"]["error"] is None
    assert "h1" not in asked.read_text().split()


def test_rollback(capsys: Printed) -> None:
    assert main.run(["rollback", "robot", "-H", "h1,bad,h2"]) == ExitCode.ROLLED_BACK
    rows, err = table(capsys)
    assert [row[:3] for row in rows] == [
        ["h1", "rolled", "back"],
        ["bad", "undone", "-"],
        ["h2", "not", "tried"],
    ]
    assert "bad: was rolled back" in err


def test_dry_run(capsys: Printed) -> None:
    assert main.run(["deploy", "-H", "h1,h2", "--dry-run"]) == 0
    out, err = capsys.readouterr()
    assert (out, err) == ("==> h1 <==\n~ a.py on h1\n\n==> h2 <==\n~ a.py on h2\n", "")


def test_a_virtual_environment_stays_here(capsys: Printed) -> None:
    venv = Path(".venv/bin/python")
    venv.parent.mkdir(parents=True)
    venv.touch()
    for words, is_told in (([], True), (["--venv", "/opt/venv"], False)):
        assert main.run(["deploy", "-H", "h1", *words]) == 0
        assert ("/.venv stays here: name" in capsys.readouterr().err) == is_told


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("nodes: [{id: a, path: %s/a.py}]\n", "cannot send node a: its path"),
        ("nodes: []\n", "list at least one node"),
        (None, "there is no such file"),
    ],
)
def test_a_project_that_no_host_hears_of(
    text: str | None, reason: str, capsys: Printed, asked: Path
) -> None:
    flow = Path("dataflow.yml")
    if text is None:
        flow.unlink()
    else:
        flow.write_text(text.replace("%s", str(Path.cwd())))
    assert main.run(["deploy", "-H", "h1"]) == ExitCode.BAD_INPUT
    out, err = capsys.readouterr()
    assert (out, reason in err, len(err.splitlines())) == ("", True, 2)
    assert not asked.exists()


def test_releases(capsys: Printed) -> None:
    answer = (
        'echo \'[{"name": "robot", "release": "20261121T220012", "state": "current"\'\n'
        'echo \', "created_us": 0, "size_bytes": 2048, "files": 3}]\'\n'
    )
    make_program(Path(os.environ["PATH"].partition(":")[0]) / "doractl", answer)
    assert main.run(["releases", "-H", "h1,dead,h2"]) == ExitCode.NO_HOST
    out, err = capsys.readouterr()
    rows = [line.split() for line in out.splitlines()]
    assert rows[0] == ["HOST", "NAME", "ID", "STATE", "CREATED", "SIZE", "FILES", "DORA", "PYTHON"]
    assert [(row[0], row[3]) for row in rows[1:]] == [
        ("h1", "current"),
        ("h2", "current"),
        ("dead", "Unreachable"),
    ]
    assert "cannot reach dead" in err
    for wrong in ("[{}]", '[{"name": "a", "release": "b", "state": "c", "files": "d"}]'):
        make_program(Path(os.environ["PATH"].partition(":")[0]) / "doractl", f"echo '{wrong}'")
        assert main.run(["releases", "-H", "h1,h2"]) == ExitCode.NO_HOST
        assert "cannot read the answer of h1" in capsys.readouterr().err


@pytest.mark.parametrize("verb", [["deploy"], ["rollback", "robot"]])
def test_hosts_at_a_time_need_hosts(verb: list[str], capsys: Printed) -> None:
    assert main.run([*verb, "--serial", "2"]) == ExitCode.USAGE
    assert "cannot use --serial 2 without -H" in capsys.readouterr().err
