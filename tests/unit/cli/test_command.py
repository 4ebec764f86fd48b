"""The command line of doractl, without a systemd behind it."""

import io
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import click
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dora_systemd import __version__
from dora_systemd.cli import listing, main
from dora_systemd.cli.group import ALIASES, HIDDEN, VERBS, doractl, run_verb
from dora_systemd.cli.listing import ListRequest
from dora_systemd.cli.parameters import current_scope
from dora_systemd.cli.verbs.look.top import parse_interval
from dora_systemd.cli.verbs.run.start import format_up
from dora_systemd.decisions.settings.table import SETTINGS
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import scope_of
from dora_systemd.verbs.facts.cells import read_cells
from tests.unit.checkout import module_paths
from tests.unit.fakes.manager import UUID, FakeManager, options
from tests.unit.project.test_manpages import all_verbs

SHORT_LIVED = ("pydantic", "websockets", "watchfiles", "lxml", "rich")
"""What verbs that are called again and again must not load."""

MOST_MODULES_OF_NO_LIST = 20
MOST_MODULES_OF_LIST = 35


@pytest.fixture
def requests(monkeypatch: pytest.MonkeyPatch) -> list[ListRequest]:
    """Lists nothing, and keeps what was asked for."""
    asked: list[ListRequest] = []
    module: Any = import_module("dora_systemd.cli.verbs.look.list")

    def print_dataflows(request: ListRequest) -> int:
        asked.append(request)
        return ExitCode.OK

    monkeypatch.setattr(listing, "print_dataflows", print_dataflows)
    monkeypatch.setattr(module, "print_dataflows", print_dataflows)
    return asked


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.run(["--version"]) == 0
    assert capsys.readouterr().out == f"doractl {__version__}\n"
    assert main.run(["-V"]) == 0
    assert capsys.readouterr().out == f"doractl {__version__}\n"
    assert main.run(["--user", "--version"]) == 0
    assert capsys.readouterr().out == f"doractl {__version__}\n"


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({}, f"Dataflow already running: {UUID} (robot)"),
        (
            {"ActiveState": "activating", "SubState": "auto-restart"},
            f"Dataflow waiting for its restart: {UUID}"
            " (robot; doractl restart robot starts it now)",
        ),
    ],
)
def test_a_start_of_what_is_up(facts: dict[str, str], words: str) -> None:
    manager = FakeManager()
    manager.units[manager.add(options())] |= facts
    (cell,) = read_cells(manager)
    assert format_up(cell) == words


def test_bare_doractl_prints_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.run([]) == 0
    shown = capsys.readouterr().out
    assert "Usage: doractl" in shown
    for name, verb in VERBS.items():
        assert (verb.summary in shown) is (name not in HIDDEN)
        assert name in shown or name in HIDDEN


@pytest.mark.parametrize("name", [*VERBS, *ALIASES])
@pytest.mark.parametrize("flag", ["-h", "--help"])
def test_every_verb_has_help_with_examples(
    name: str, flag: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main.run([name, flag]) == 0
    shown = capsys.readouterr().out
    assert [line for line in shown.splitlines() if len(line) > 80] == []
    assert "Examples:" in shown
    assert f"doractl {ALIASES.get(name, name)}" in shown


@pytest.mark.parametrize("verb", sorted(all_verbs()))
def test_examples_fit_a_narrow_terminal(
    verb: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are broken as a shell reads them."""
    shown = {}
    for columns in ("60", "100"):
        monkeypatch.setenv("COLUMNS", columns)
        assert main.run([*verb.split(), "--help=all"]) == 0
        shown[columns] = capsys.readouterr().out.partition("\nExamples:\n")[2]
    assert [line for line in shown["60"].splitlines() if len(line) > 60] == []
    assert re.sub(r"( \\)?\s+", " ", shown["60"]) == re.sub(r"\s+", " ", shown["100"])


@pytest.mark.parametrize("verb", ["start", "run", "deploy"])
def test_the_usual_options_are_one_screen(
    verb: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main.run([verb, "--help"]) == 0
    short = capsys.readouterr().out.splitlines()
    assert len(short) <= 30
    monkeypatch.setenv("COLUMNS", "100")  # examples are whole
    for words in ([verb, "--help=all"], ["help", verb, "--help=all"], [verb, "x", "--help=all"]):
        assert main.run(words) == 0
        full = capsys.readouterr().out
        command = VERBS[verb].command
        shown = [one for one in options_of(command) if not one.hidden]
        assert not [one.opts[0] for one in shown if one.opts[0] not in full]
        assert all(line in full for line in (command.epilog or "").splitlines()[1:])
    (count,) = [line.split()[-2] for line in short if "--help=all" in line]
    assert int(count) == len(shown) + 1  # and -h


def test_no_machine_to_check(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No output at all would look as if all of them were in order."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert main.run(["--user", "machine", "check"]) == 0
    assert capsys.readouterr().out == "No machine is declared.\n"


@pytest.mark.parametrize("name", ["node", "machine"])
def test_the_summaries_of_a_group_are_whole(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    assert main.run([name, "--help"]) == 0
    shown = capsys.readouterr().out.partition("\nCommands:\n")[2].partition("\n\n")[0]
    group = VERBS[name].command
    assert isinstance(group, click.Group)
    assert shown.startswith(f"  {min(group.commands)} ")
    assert "..." not in shown
    assert shown.endswith(".")


def test_help_of_all_options_everywhere(capsys: pytest.CaptureFixture[str]) -> None:
    for verb in (["list"], ["node", "restart"]):
        assert main.run([*verb, "--help"]) == 0
        shown = capsys.readouterr().out
        assert main.run([*verb, "--help=all"]) == 0
        assert capsys.readouterr().out == shown
    # Behind -- it is a word of somebody else's.
    assert main.run(["inhibit", "robot", "--help", "--", "true", "--help=all"]) == 0


def options_of(command: click.Command) -> Iterator[click.Option]:
    if isinstance(command, click.Group):
        for one in command.commands.values():
            yield from options_of(one)
    yield from (one for one in command.params if isinstance(one, click.Option))


@pytest.mark.parametrize("name", VERBS)
def test_every_option_says_what_it_does(name: str) -> None:
    command = doractl.get_command(click.Context(doractl), name)
    assert command is not None
    for option in options_of(command):
        assert option.help, option.name
        assert option.help.endswith("."), option.name


@pytest.mark.parametrize(
    ("arguments", "message", "hint"),
    [
        (["strat"], "unknown command 'strat'", "did you mean doractl start?"),
        (["ls"], "unknown command 'ls'", "did you mean doractl list?"),
        (
            ["st"],
            "unknown command 'st'",
            "did you mean doractl start or doractl stop or doractl status?",
        ),
        (["ver"], "unknown command 'ver'", "did you mean doractl version?"),
        (["tail"], "unknown command 'tail'", "did you mean doractl logs NAME --follow?"),
        (["biuld"], "unknown command 'biuld'", "did you mean doractl build?"),
        (["qqq"], "unknown command 'qqq'", "doractl --help lists all commands"),
        (["membe"], "unknown command 'membe'", "doractl --help lists all commands"),
        (["node"], "missing command", "valid commands: restart, stop"),
        (["node", "lits"], "unknown command 'node lits'", "valid commands: restart, stop"),
        (["node", "list"], "unknown command 'node list'", "did you mean doractl list NAME?"),
        (["machine", "ls"], "unknown command 'machine ls'", "did you mean doractl machine list?"),
        (["start", "--grace", "1s"], "unknown option --grace", "did you mean --grace-duration?"),
        (["list", "--oll"], "unknown option --oll", "did you mean --all?"),
        (
            ["start", "--memroy-limit"],
            "unknown option --memroy-limit",
            "did you mean --memory-limit?",
        ),
        (["why", "--bundle", ""], "cannot read '': no path", "doractl why --bundle FILE"),
        (["bundle", "x", "-o", ""], "cannot write a bundle to '': no path", "doractl bundle"),
        (["bundle", "x", "-o", "-"], "cannot write a bundle to '-': no path", "doractl bundle"),
        (["bundle", "x", "-o", "a/"], "cannot write a bundle to 'a/': no path", "doractl bundle"),
        (["stop"], "cannot stop: give names or --all", "doractl stop NAME, or doractl stop --all"),
        (["stop", "x", "--all"], "cannot stop: give names or --all, not both", ""),
        (["show"], "missing argument", "see doractl show --help"),
        (["start", "--watch"], "option '--watch' requires an argument", "see doractl start --help"),
        (["list", "a", "b"], "got unexpected extra", ""),
        (["list", "-o", "xml"], "invalid value", ""),
        (["list", "--last", "0"], "invalid value", ""),
        (["list", "x", "--status", "failed"], "cannot filter a single dataflow", "--last, "),
        (["list", "--sort-by", "uuid"], "invalid value for '--sort-by'", ""),
    ],
)
def test_wrong_command_lines(
    arguments: list[str], message: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main.run(arguments) == ExitCode.USAGE
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert out == ""
    assert len(lines) == 2
    assert lines[0].startswith(f"doractl: {message}")
    assert lines[1].startswith(f"hint: {hint}")


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        *(("inspect", "show"), ("stat", "status"), ("monit", "top"), ("htop", "top")),
        *(("rm", "stop"), ("kill", "stop"), ("delete", "stop"), ("remove", "stop")),
        *(("down", "destroy"), ("log", "logs"), ("journal", "logs"), ("create", "start")),
        *(("check", "start --dry-run"), ("validate", "start --dry-run")),
    ],
)
def test_commands_of_others(word: str, meant: str, capsys: pytest.CaptureFixture[str]) -> None:
    """What docker, pm2, systemctl and dora call it; a similar word would lead elsewhere."""
    assert main.run([word, "robot"]) == ExitCode.USAGE
    first, hint = capsys.readouterr().err.splitlines()
    assert first == f"doractl: unknown command '{word}'"
    assert hint == f"hint: did you mean doractl {meant}?"


@pytest.mark.parametrize(
    "arguments", [["--user", "x"], ["x", "--user"], ["--system", "x", "--user"]]
)
def test_scope_before_and_after_the_verb(arguments: list[str]) -> None:
    from dora_systemd.cli.group import VerbGroup
    from dora_systemd.cli.parameters import scope_options

    seen = []

    @click.command("x")
    @scope_options
    def verb() -> None:
        seen.append(current_scope())

    class OneVerb(VerbGroup):
        def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:
            del ctx, cmd_name
            return verb

    @click.group(cls=OneVerb)
    @scope_options
    def group() -> None:
        pass

    group.main(arguments, standalone_mode=False)
    assert seen == [scope_of(True)]


def words_of_list() -> set[str]:
    """Every way to write every option that click or the quick way knows, and words beside them."""
    command = VERBS["list"].command
    found = {*listing._FLAGS, "robot", "x", "", "-", "--", "-h", "--al", "-oa", "json", "xml"}
    for option in options_of(command):
        spelled = {*option.opts, *option.secondary_opts}
        values = [*getattr(option.type, "choices", ["x"]), ""]
        found |= spelled | {
            f"{one}{sign}{value}" for one in spelled for value in values for sign in ("", "=")
        }
        found |= {*values}
    return found


words = st.lists(st.sampled_from(sorted(words_of_list())), max_size=5)


def by_click(requests: list[ListRequest], arguments: list[str]) -> ListRequest:
    requests.clear()
    assert doractl.main(["list", *arguments], standalone_mode=False) == ExitCode.OK
    return requests[0]


def check_quick_way(requests: list[ListRequest], arguments: list[str]) -> None:
    quick = listing.parse_list(arguments)
    if quick is not None:
        expected = quick._replace(is_user=scope_of(quick.is_user).is_user)
        assert by_click(requests, arguments) == expected


def test_the_quick_way_to_list_knows_what_click_knows(requests: list[ListRequest]) -> None:
    """Every option that click or the quick way declares, alone and with each value."""
    every = sorted(words_of_list())
    for arguments in ([], *([one] for one in every), *product(every, repeat=2)):
        check_quick_way(requests, list(arguments))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(arguments=words)
def test_the_quick_way_to_list_means_what_click_means(
    requests: list[ListRequest], arguments: list[str]
) -> None:
    check_quick_way(requests, arguments)


def test_the_quick_way_is_taken_under_all_names_of_list() -> None:
    names = {alias for alias, verb in ALIASES.items() if verb == "list"}
    assert {*main.LIST_VERBS} == {"list", *names}


@pytest.mark.parametrize("verb", main.LIST_VERBS)
def test_list_by_all_its_names(verb: str, requests: list[ListRequest]) -> None:
    assert main.run([verb, "robot", "-o", "json"]) == 0
    assert main.run(["--user", verb]) == 0
    assert requests == [ListRequest("robot", output="json"), ListRequest(is_user=True)]


def test_what_list_selects(requests: list[ListRequest]) -> None:
    words = ["--status", "Failed", "--name", "rob", "--sort-by", "cpu", "--last", "3", "--quiet"]
    assert main.run(["--user", "list", *words]) == 0
    (request,) = requests
    assert (request.status, request.pattern, request.sort_by) == ("failed", "rob", "cpu")
    assert (request.last, request.is_quiet, request.is_filtered) == (3, True, True)
    assert not ListRequest().is_filtered


def failing(error: BaseException) -> Callable[[list[str]], int]:
    """A verb that raises it."""

    def fail(_arguments: list[str]) -> int:
        raise error

    return fail


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (DoraSystemdError("cannot do it", "do that", ExitCode.NAME_IN_USE), ExitCode.NAME_IN_USE),
        (KeyboardInterrupt(), ExitCode.INTERRUPTED),
    ],
)
def test_exit_status_of_errors(
    error: BaseException,
    status: int,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main.run(["list"], failing(error)) == status
    expected = "doractl: cannot do it\nhint: do that\n" if status != 130 else ""
    assert capsys.readouterr().err == expected


def test_a_question_that_is_interrupted_ends_its_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The prompt of the shell comes in the next line, after Ctrl+D, too."""
    monkeypatch.setattr("sys.stdin", io.StringIO())
    asking = click.Group(commands={"ask": click.Command("ask", callback=lambda: ask())})

    def ask() -> None:
        click.confirm("Stop robot?", err=True)

    assert run_verb(["ask"], asking) == ExitCode.INTERRUPTED
    assert capsys.readouterr().err == "Stop robot? [y/N]: \n"


@pytest.mark.parametrize("text", ["nan", "inf", "1e9", "-1", "0", "0.09", "x", ""])
def test_top_refuses_an_interval_that_it_cannot_wait(text: str) -> None:
    with pytest.raises(DoraSystemdError, match="as an interval") as caught:
        parse_interval(text)
    assert caught.value.code is ExitCode.USAGE
    assert [parse_interval(one) for one in ("2", "2.0", ".5", "99999")] == [2.0, 2.0, 0.5, 99999.0]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(2, "No such file", "/x"), "cannot continue: No such file\nhint: /x\n"),
        (OSError(9, "Bad file descriptor", 7), "cannot continue: Bad file descriptor\n"),
        (OSError(28, "No space left"), "cannot write output: No space left\n"),
        (TimeoutError("timed out"), "cannot continue: timed out\n"),
        (TimeoutError(), "cannot continue: TimeoutError\n"),
    ],
)
def test_any_error_of_the_system_is_one_line(
    error: OSError,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    given_up: list[int] = []
    monkeypatch.setattr(os, "dup2", lambda *fds: given_up.extend(fds))
    assert main.run(["list"], failing(error)) == ExitCode.FAILURE
    monkeypatch.undo()
    assert capfd.readouterr().err == f"doractl: {said}"
    # Else what was done would not be printed.
    assert (given_up[1:] == [sys.stdout.fileno()]) is ("write output" in said)


def test_a_current_directory_that_was_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert main.run(["why", "--bundle", "robot.tar"]) == ExitCode.BAD_INPUT
    said = "doractl: cannot continue: the current directory was removed\nhint: cd to a directory"
    assert capfd.readouterr().err.startswith(said)


def test_a_reader_that_went_away_is_no_error() -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "dora_systemd.cli.main", "--help"]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, check=False)
    os.close(write)
    assert done.returncode == 141
    assert done.stderr == b""


@pytest.mark.parametrize(
    "module",
    [
        "listing",
        *(
            f"verbs.{one}"
            for one in ("look.list", "run.stop", "run.restart", "look.show", "look.logs")
        ),
    ],
)
def test_light_verbs_stay_light(module: str) -> None:
    script = (
        f"import sys, dora_systemd.cli.{module}\n"
        f"print(*[m for m in {SHORT_LIVED} if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == []


@pytest.mark.parametrize(
    ("more", "most"),
    [("", MOST_MODULES_OF_NO_LIST), ("dora_systemd.verbs.facts.list", MOST_MODULES_OF_LIST)],
)
def test_list_loads_little(more: str, most: int) -> None:
    """No click, and few modules of our own: each takes a third of a millisecond.

    more: what comes when a dataflow runs.
    """
    modules = ", ".join(filter(None, ("dora_systemd.cli.main", "dora_systemd.cli.listing", more)))
    script = f"import sys, {modules}; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    loaded = set(done.stdout.split())
    assert not loaded & {"click", "asyncio", "subprocess"}
    ours = {name.removeprefix("dora_systemd.") for name in loaded} & module_paths().keys()
    assert len(ours) <= most, sorted(ours)


def test_version_loads_next_to_nothing() -> None:
    script = "import sys, dora_systemd.cli.main; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    ours = {name for name in done.stdout.split() if name.startswith("dora_systemd.")}
    assert ours == {
        *("dora_systemd.cli", "dora_systemd.cli.main", "dora_systemd.cli.edge"),
        *("dora_systemd.errors", "dora_systemd.terminal_text"),
    }


@pytest.mark.parametrize("verb", ["start", "run"])
def test_settings_stand_by_concern_with_their_defaults(
    capsys: pytest.CaptureFixture[str], verb: str
) -> None:
    assert main.run([verb, "--help=all"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    titles = ["Options:", "Nodes:", "Limits:", "Restarts:"]
    titles += ["Sandbox and secrets:", "Hot reload:"]
    places = [shown.index(f" {title} -") for title in titles]
    assert places == sorted(places)
    for setting in SETTINGS:
        assert setting.only_nodes or shown.count(f" {setting.flags[0]}") >= 1
    assert "Maximum restarts per window; default: 5." in shown


def test_help_is_a_word_too(capsys: pytest.CaptureFixture[str]) -> None:
    for verb in ([], ["stop"], ["node"], ["node", "restart"]):
        assert main.run([*verb, "--help"]) == 0
        shown = capsys.readouterr().out
        assert main.run(["help", *verb]) == 0
        assert capsys.readouterr().out == shown
    assert main.run(["help", "stpo"]) == ExitCode.USAGE
    assert "did you mean doractl stop?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("redirection", "status", "said"),
    [
        (">/dev/full", 1, "doractl: cannot write output: No space left on device\n"),
        (">&-", 0, ""),
        ("2>&- >&-", 0, ""),
    ],
)
@pytest.mark.parametrize("verb", ["--help", "--version"])
def test_output_that_cannot_be_written(redirection: str, status: int, said: str, verb: str) -> None:
    shell = f"{sys.executable} -m dora_systemd.cli.main {verb} {redirection}"
    done = subprocess.run(["/bin/sh", "-c", shell], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr, done.stdout) == (status, said, "")


def test_a_build_needs_time(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.run(["deploy", "--build-timeout", "0"]) == ExitCode.USAGE
    told = capsys.readouterr().err
    assert told == (
        "doractl: cannot use 0 as --build-timeout\n"
        "hint: write a time such as 30min, or --no-build\n"
    )


CLOSED = ("", "<&-", ">&-", "2>&-", "<&- >&- 2>&-")
WRONG = ("nosuch", "list --last 0", "top -x", "list -q -o json")
"""Each is refused by a parser of its own."""


@pytest.mark.parametrize(
    ("verb", "streams"),
    [
        *(("stop", streams) for streams in (*CLOSED, "2>/dev/full", "2>/dev/full >&2")),
        *((verb, streams) for verb in WRONG for streams in ("2>&-", "2>/dev/full")),
    ],
)
def test_errors_that_cannot_be_printed(verb: str, streams: str) -> None:
    """Nobody reads them, their disk is full, or there is no such stream."""
    shell = ["/bin/sh", "-c", f"{sys.executable} -m dora_systemd.cli.main {verb} {streams}"]
    done = subprocess.run(shell, stdout=-1, stderr=-1, text=True, check=False)
    assert done.returncode == ExitCode.USAGE, done.stderr
    assert done.stdout == ""
    assert "2>" in streams or len(done.stderr.splitlines()) <= 2, done.stderr


def test_errors_without_a_reader() -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "dora_systemd.cli.main", "list", "--last", "0"]
    for stdout in (None, write):
        done = subprocess.run(command, stdout=stdout, stderr=write, check=False)
        assert done.returncode == ExitCode.USAGE
    os.close(write)


flags = st.sampled_from(
    ["--name", "--env", "--env-file", "--property", "--venv", "--dora", "--uid", "--grace-duration"]
)
anything = st.text(st.characters(exclude_characters="\0"), max_size=20)


@given(file=anything, options=st.lists(st.tuples(flags, anything), max_size=3))
def test_any_command_line_of_start_is_answered(file: str, options: list[tuple[str, str]]) -> None:
    words = [f"{flag}={text}" for flag, text in options]
    status = main.run(["--user", "start", "--dry-run", *words, "--", file or "x"])
    assert status in set(ExitCode)
    assert status != ExitCode.OK


def test_names_of_files_in_any_encoding(tmp_path: Path) -> None:
    flow = os.fsencode(tmp_path / "flow-") + b"\xff.yml"
    words = ("-m", "dora_systemd.cli.main", "start", "--dry-run", "--user")
    command = [os.fsencode(sys.executable), *map(os.fsencode, words), flow]
    done = subprocess.run(command, capture_output=True, check=False)
    assert done.returncode == ExitCode.BAD_INPUT
    assert done.stderr.startswith(b"doractl: cannot read ")
    assert len(done.stderr.splitlines()) == 2


def test_a_mistake_of_ours_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fail = failing(TypeError("oh"))
    assert main.run(["list"], fail) == 1
    said = capsys.readouterr().err.splitlines()
    assert said[0] == "doractl: internal error in doractl (TypeError: oh)"
    assert "DORACTL_DEBUG" in said[1]
    monkeypatch.setenv("DORACTL_DEBUG", "1")
    with pytest.raises(TypeError):
        main.run(["list"], fail)
