"""The manuals say what the code does: options, settings, exit statuses, events."""

import re
import subprocess
from pathlib import Path
from typing import Any

import click
import pytest

from dora_systemd.adapters.host import files
from dora_systemd.adapters.host.watch import IDLE_MS
from dora_systemd.cli.group import VERBS, doractl
from dora_systemd.decisions.gateway.place import ADDRESS_VARIABLE, PORT_VARIABLE
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.logs.journal_events import EVENTS
from dora_systemd.decisions.settings.kinds import Setting
from dora_systemd.decisions.settings.schema import validate_settings
from dora_systemd.decisions.settings.table import SETTINGS
from dora_systemd.decisions.why.remedies import known_remedy
from dora_systemd.errors import ExitCode
from dora_systemd.verbs.start.read import SYSTEM_FILE
from tests.unit.checkout import CHECKOUT
from tests.unit.tools import require

MAN = CHECKOUT / "packaging/man"
PAGES = sorted(MAN.iterdir())
COMMON = {"--system", "--user", "-H", "--host", "-h", "--help"}


def sections(page: str) -> dict[str, str]:
    """The source of a page by heading, of sections and subsections alike."""
    text = (MAN / page).read_text()
    found = re.split(r"^\.S[hs] (.+)\n", text, flags=re.M)
    return dict(zip(found[1::2], found[2::2], strict=True))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_lines_of_the_source_fit_80_columns(page: Path) -> None:
    """mandoc and lintian ask for it; examples are as wide as what they show."""
    text = re.sub(r"^\.Bd -literal.*?^\.Ed$", "", page.read_text(), flags=re.M | re.S)
    assert [line for line in text.splitlines() if len(line) > 80 and line[0] != "."] == []


def documented_options(source: str) -> set[str]:
    """What stands behind Fl in the items of a list."""
    items = re.findall(r"^\.It (Fl .+)$", source, flags=re.M)
    return {f"-{flag}" for item in items for flag in re.findall(r"Fl (-?[a-zA-Z][a-z-]*)", item)}


def declared_options(command: click.Command) -> set[str]:
    return {
        flag
        for param in command.params
        if isinstance(param, click.Option) and not param.hidden
        for flag in (*param.opts, *param.secondary_opts)
    }


def all_verbs() -> dict[str, click.Command]:
    """Every verb by the words that call it; a group by those of its members."""
    found: dict[str, click.Command] = {}
    for name in VERBS:
        command = doractl.get_command(click.Context(doractl), name)
        assert command is not None
        members = command.commands if isinstance(command, click.Group) else {}
        found |= {f"{name} {word}": one for word, one in members.items()} or {name: command}
    return found


def test_the_first_page_is_short() -> None:
    """What somebody reads first: the other pages have the rest."""
    assert len((MAN / "dora-systemd.7").read_text().splitlines()) <= 500


def test_every_verb_has_an_entry() -> None:
    headings = list(sections("doractl.1"))
    first, last = headings.index("VERBS") + 1, headings.index("ENVIRONMENT")
    assert sorted(headings[first:last]) == sorted(all_verbs())


@pytest.mark.parametrize("verb", sorted(all_verbs()))
def test_options_of_the_page_are_those_of_help(verb: str) -> None:
    documented = documented_options(sections("doractl.1")[verb])
    assert documented == declared_options(all_verbs()[verb]) - COMMON


@pytest.mark.parametrize("verb", sorted(all_verbs()))
def test_values_and_defaults_are_those_of_help(verb: str) -> None:
    """The default stands in the entry of an option; of several values it is the first."""
    items = re.split(r"^\.It ", sections("doractl.1")[verb], flags=re.M)[1:]
    for param in all_verbs()[verb].params:
        if not isinstance(param, click.Option) or not (default := param.to_info_dict()["default"]):
            continue
        flag = param.opts[-1][1:]
        (entry,) = (one for one in items if re.search(rf"Fl {flag}(?: |$)", one, flags=re.M))
        assert re.search(
            rf"\b{re.escape(f'{default:g}' if isinstance(default, int | float) else default)}\b",
            entry,
        )
        if isinstance(param.type, click.Choice):
            listed = entry.partition("\n")[0].partition("Cm ")[2].split(" | ")
            assert listed == list(param.type.choices)
            assert listed[0] == default


@pytest.mark.parametrize("verb", sorted(all_verbs()))
def test_synopses_are_those_of_help(verb: str) -> None:
    (macros,) = re.findall(r"^\.D1 Nm Cm (.*)$", sections("doractl.1")[verb], flags=re.M)
    text = re.sub(r"\b(?:Ar|No) ", "", macros).replace(r"\-", "-")
    text = re.sub(r"Oo (.*?) Oc", r"[\1]", text)
    shown = re.sub(r"\bOp (.*)", r"[\1]", text)
    command = all_verbs()[verb]
    context = click.Context(command, **doractl.context_settings)
    usage = " ".join([verb, *command.collect_usage_pieces(context)])
    usage = usage.replace("[OPTIONS]", "[OPTION...]").replace("]...", "...]")
    assert shown.replace(" ...", "...") == usage


def test_common_options() -> None:
    assert documented_options(sections("doractl.1")["Common options"]) == COMMON


def test_exit_statuses() -> None:
    listed = re.findall(r"^\.It (\d+)$", sections("doractl.1")["EXIT STATUS"], flags=re.M)
    assert [int(number) for number in listed] == [int(code) for code in ExitCode]


def test_exit_statuses_of_the_unit() -> None:
    listed = re.findall(r"^\.It (\d+)$", sections("dora-systemd.7")["EXIT STATUS"], flags=re.M)
    assert [int(number) for number in listed] == [int(code) for code in RunnerExit]
    run = sections("doractl.1")["EXIT STATUS"].partition("ends with the exit status of the")[2]
    assert str(int(RunnerExit.ENGINE_LOST)) in run


def test_settings_files_of_the_examples(tmp_path: Path) -> None:
    text = sections("dora-systemd.yml.5")["EXAMPLES"]
    blocks = re.findall(r"^\.Bd -literal.*\n((?:.*\n)*?)^\.Ed", text, flags=re.M)
    assert len(blocks) == 2
    for block in blocks:
        path = tmp_path / "config.yml"
        path.write_text(block)
        validate_settings(files.read_yaml(path), SETTINGS)


def entries() -> dict[str, str]:
    """The entries of dora-systemd.yml(5) by key."""
    found = re.split(r"^\.It Va (\S+)\n", sections("dora-systemd.yml.5")["SETTINGS"], flags=re.M)
    return dict(zip(found[1::2], found[2::2], strict=True))


def test_every_setting_has_an_entry_in_order() -> None:
    assert list(entries()) == [setting.name for setting in SETTINGS]


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda setting: setting.name)
def test_entries_are_true(setting: Setting[Any]) -> None:
    entry = entries()[setting.name]
    option = re.search(r"^Option:\n\.(Fl .+)$", entry, flags=re.M)
    words = documented_options(f".It {option[1]}\n") if option else set()
    negative = {f"--no-{setting.flags[0][2:]}"} if setting.flags and setting.kind.is_flag else set()
    assert words == {*setting.flags, *negative}
    variables = re.findall(r"^\.Ev (DORA_\w+)", entry, flags=re.M)
    assert variables == ([setting.variable] if setting.variable else [])
    assert ("may be repeated" in entry) == setting.kind.is_repeatable
    values = setting.kind.format(setting.default) if setting.default else []
    default = ", ".join(values) or ("no" if setting.default is False else "none")
    assert re.search(rf"^Default: {re.escape(default)}[.;,]", entry, flags=re.M), default


def test_which_settings_are_roots_alone() -> None:
    text = (MAN / "dora-systemd.yml.5").read_text()
    text = text.partition(".Ss Trust in settings files\n")[2].partition("Below\n")[0]
    named = re.findall(r"^\.Va (\S+)", text, flags=re.M)
    assert sorted(named) == sorted(one.name for one in SETTINGS if one.root_only)


def test_variables_of_the_command() -> None:
    text = sections("doractl.1")["ENVIRONMENT"]
    listed = re.findall(r"\b(DORA_[A-Z_]+)", text)
    settings = filter(None, (setting.variable for setting in SETTINGS))
    options = [
        param.envvar
        for command in all_verbs().values()
        for param in command.params
        if isinstance(param.envvar, str)
    ]
    known = {*settings, *options, PORT_VARIABLE, ADDRESS_VARIABLE}
    assert sorted(set(listed)) == sorted(known)


def test_events() -> None:
    found = re.findall(r"^\.It Li (\S+)\n(?:.*\n)*?([0-9a-f]{32})$", events_text(), flags=re.M)
    assert found == [(name, kind.message_id) for name, kind in EVENTS.items()]


def events_text() -> str:
    return sections("dora-systemd-logs.7")["LIFE EVENTS"]


def test_options_that_other_pages_name() -> None:
    foreign = {"-hub-override", "-locked", "-no-block"}  # dora's and systemctl's
    declared = COMMON.union(*map(declared_options, all_verbs().values()))
    text = "".join(page.read_text() for page in PAGES if page.name != "doractl.1")
    named = set(re.findall(r"\bFl (-[a-z][a-z-]*)", text))
    assert named - {flag[1:] for flag in declared} == foreign


def test_the_cache_of_uv_is_that_of_the_hint() -> None:
    hint = known_remedy(["error: Failed to initialize cache at `/.cache/uv`"])
    (options,) = re.findall(r"--property CacheDirectory=NAME --env \S+", hint)
    text = sections("dora-systemd-security.7")["SANDBOX"]
    assert options.replace("NAME", "robot") in text


def test_when_a_replaced_directory_is_noticed() -> None:
    assert f"within {IDLE_MS // 1000} seconds" in sections("dora-systemd-nodes.7")["HOT RELOAD"]


def test_files() -> None:
    for page in ("doractl.1", "dora-systemd.yml.5"):
        assert str(SYSTEM_FILE) in sections(page)["FILES"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_man_has_no_warnings(page: Path) -> None:
    require("man")
    command = ["man", "-l", "--warnings", "-E", "UTF-8", "-Tutf8", "-Z", str(page)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_mandoc_has_no_complaints(page: Path) -> None:
    require("mandoc")
    command = ["mandoc", "-T", "lint", "-W", "style", str(page)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    # Which other manuals there are is this machine's business.
    lines = [one for one in done.stdout.splitlines() if "referenced manual not found" not in one]
    assert lines == []
