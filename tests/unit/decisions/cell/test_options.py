"""The runner's command line: options to arguments and back."""

import shlex
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.options import (
    MODULES,
    RunnerOptions,
    SettingText,
    format_runner_argv,
    known_options_from_command,
    options_from_command,
    parse_runner_argv,
    runner_command,
)
from dora_systemd.errors import DoraSystemdError
from dora_systemd.values import INFINITY, SECOND

UUID = "550e8400-e29b-41d4-a716-446655440000"
OPTIONS = RunnerOptions("robot", UUID, "/srv/robot.yml", "/srv", "/usr/bin/dora")

texts = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]))
paths = texts.map(lambda text: "/" + text)
idents = st.from_regex(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,20}", fullmatch=True)
given_settings = st.builds(SettingText, st.just("") | idents, st.sampled_from([*MODULES]), texts)
options = st.builds(
    RunnerOptions,
    name=st.from_regex(r"[a-z][a-z0-9_-]{0,20}(?<!-)", fullmatch=True).filter(
        lambda n: n != "gateway"
    ),
    uuid=st.uuids().map(str),
    dataflow=paths,
    working_directory=paths,
    dora=paths,
    venv=st.none() | paths,
    uv=st.booleans(),
    debug=st.booleans(),
    allow_shell_nodes=st.booleans(),
    grace=st.integers(0, 2**64 - 1),
    settings=st.lists(given_settings).map(tuple),
    placed=st.just(()),
    machine=st.just(""),
    head=st.just(""),
    addresses=st.just(()),
    attached=st.booleans(),
    exit_when_nodes_finish=st.none() | st.booleans(),
    env_keys=st.lists(texts).map(tuple),
    start_timeout=st.integers(min_value=1, max_value=10**12) | st.just(INFINITY),
)


def test_arguments_are_readable() -> None:
    assert shlex.join(format_runner_argv(OPTIONS)) == (
        f"--name=robot --uuid={UUID} --working-directory=/srv --dora=/usr/bin/dora "
        "--grace-duration=10s /srv/robot.yml"
    )


ALL = RunnerOptions(
    *("robot", UUID, "/srv/robot.yml", "/srv", "/usr/bin/dora", "/srv/venv"),
    uv=True,
    debug=True,
    allow_shell_nodes=True,
    grace=5 * SECOND,
    attached=True,
    exit_when_nodes_finish=False,
    env_keys=("MODEL", "RATE"),
    start_timeout=90 * SECOND,
    settings=(
        SettingText("camera", "nice", "5"),
        SettingText("camera", "owes", "image:within=2s,first=1min 30s,then=warn"),
        SettingText("", "restart_policy", "on-failure"),
        SettingText("a:b", "max_restarts", "infinity"),
        SettingText("", "stop_limit", "1h"),
        SettingText("camera", "watch", "x=y"),
        SettingText("", "replace", "start-first"),
    ),
)
ARGUMENTS = f"""\
--name=robot --uuid={UUID} --working-directory=/srv --dora=/usr/bin/dora --grace-duration=5s
--venv=/srv/venv --exit-when-nodes-finish=no
'--start-timeout=1min 30s'
--env-key=MODEL --env-key=RATE
--set=camera:nice=5 '--set=camera:owes=image:within=2s,first=1min 30s,then=warn'
--set=restart_policy=on-failure --set=a:b:max_restarts=infinity --set=stop_limit=1h
--set=camera:watch=x=y --set=replace=start-first
--uv --debug --allow-shell-nodes --attached /srv/robot.yml
"""


def test_unit_files_on_machines_have_these_arguments() -> None:
    """After a release, those of enabled dataflows must go on working."""
    assert format_runner_argv(ALL) == shlex.split(ARGUMENTS)
    assert parse_runner_argv(shlex.split(ARGUMENTS)) == ALL
    short = ["--dora=/usr/bin/dora", f"--uuid={UUID}", "--name=robot", "--working-directory=/srv"]
    assert parse_runner_argv([*short, "/srv/robot.yml"]) == OPTIONS


@given(options)
def test_arguments_and_back(given_options: RunnerOptions) -> None:
    assert parse_runner_argv(format_runner_argv(given_options)) == given_options
    command = runner_command("/usr/bin/python3", given_options)
    assert options_from_command(command) == given_options
    assert hash(given_options), "doractl stop and restart take each dataflow once"


@given(st.lists(st.text() | st.sampled_from(format_runner_argv(OPTIONS))))
def test_garbage_is_refused_by_our_error(argv: list[str]) -> None:
    try:
        parse_runner_argv(argv)
    except DoraSystemdError as error:
        assert error.message.isprintable()


@pytest.mark.parametrize(
    "argv",
    [
        [],
        ["/srv/robot.yml"],
        [*format_runner_argv(OPTIONS)[:-1], "robot.yml"],
        ["--uv", *format_runner_argv(OPTIONS), "/x"],
        ["--name=a", *format_runner_argv(OPTIONS)],
        ["--colour=red", *format_runner_argv(OPTIONS)],
        ["--uv=yes", *format_runner_argv(OPTIONS)],
        ["--venv", *format_runner_argv(OPTIONS)],
        ["--uv", "--uv", *format_runner_argv(OPTIONS)],
        ["watch=*.py", *format_runner_argv(OPTIONS)],
    ],
)
def test_bad_command_lines(argv: list[str]) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot read the runner's command line"):
        parse_runner_argv(argv)


def test_other_commands_are_no_runners() -> None:
    with pytest.raises(DoraSystemdError, match="is not a runner"):
        options_from_command(["/usr/bin/python3", "-m", "http.server"])


@pytest.mark.parametrize(
    "unknown", ["--colour=red", "--colour", "--start-timeout=often", "--uv=yes"]
)
def test_options_of_another_version_are_left_out(unknown: str) -> None:
    command = runner_command("/usr/bin/python3", OPTIONS)
    command.insert(-1, unknown)
    with pytest.raises(DoraSystemdError):
        options_from_command(command)
    assert known_options_from_command(command) == OPTIONS


@pytest.mark.parametrize("wrong", ["--name=a b", "--uuid=1"])
def test_whose_command_it_is_must_be_known(wrong: str) -> None:
    key = wrong.partition("=")[0]
    command = runner_command("/usr/bin/python3", OPTIONS)
    command = [wrong if one.startswith(f"{key}=") else one for one in command]
    with pytest.raises(DoraSystemdError):
        known_options_from_command(command)
    with pytest.raises(DoraSystemdError, match="missing"):
        known_options_from_command([one for one in command if one != wrong])


def test_reading_options_is_cheap() -> None:
    """`list` reads the command line of every unit."""
    code = "import sys, dora_systemd.decisions.cell.options; print('argparse' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
