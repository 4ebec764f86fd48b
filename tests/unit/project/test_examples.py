"""Every doractl command in manuals, --help, README, transcripts and messages is one that exists.

Commands of examples must be complete; those in a text may lack arguments.
"""

import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import click
import pytest

from dora_systemd.cli.group import VERBS, doractl
from dora_systemd.cli.remote.dispatch import valued_options
from dora_systemd.cli.setting_options import SettingsCommand
from dora_systemd.decisions.remote.command_line import part_hosts
from dora_systemd.decisions.settings.resolve import require_effect, resolve_settings
from dora_systemd.errors import DoraSystemdError
from tests.system.typed import command_of, typed_lines
from tests.unit.checkout import CHECKOUT
from tests.unit.project.test_manpages import PAGES, all_verbs
from tests.unit.project.test_words import MODULES, strings

MARKDOWN = [
    *(CHECKOUT / name for name in ("README.md", "HACKING.md", "CHANGELOG.md", "SECURITY.md")),
    *sorted((CHECKOUT / "docs").glob("*.md")),
]
TASKS = sorted((CHECKOUT / "tests/system/transcripts").glob("*.txt"))
ROFF = {r"\-": "-", r"\(aq": "'", r"\&": "", r"\e": "\\"}
CATALOG = CHECKOUT / "units/templates/dora-systemd.catalog"
PROSE = re.compile(r"\bdoractl ((?:--(?:user|system) )?[a-z]+(?: (?:--?[a-z-]+|[A-Z]+|\{\}))*)")
"""A command in the middle of a sentence, as far as it surely goes; {} is filled in later."""
NO_VERBS = ("on", "was", "with", "about", "has", "may", "shows", "reads", "itself", "needs")


def commands(line: str) -> Iterator[list[str]]:
    """The arguments of each doractl in a line for a shell."""
    for inner in re.findall(r"\$\(([^()]*)\)", line):
        yield from commands(inner)
    words = shlex.shlex(re.sub(r"\$\([^()]*\)", "x", line), posix=True, punctuation_chars=True)
    words.whitespace_split = True
    found: list[str] | None = None
    for word in [*words, ";"]:
        if set(word) <= set("();<>|&"):
            if found is not None:
                yield found
            found = None
        elif found is not None:
            found.append(word)
        elif word == "doractl":
            found = []


def problem(arguments: Sequence[str], is_part: bool = False) -> str:
    """What click says about a command line; a part of one may lack arguments."""
    try:
        with redirect_stdout(StringIO()):
            parse(doractl, "doractl", part_hosts(arguments, valued_options).words, None)
    except DoraSystemdError as error:
        return error.message
    except click.MissingParameter as error:
        return "" if is_part else error.format_message()
    except click.BadOptionUsage as error:
        return "" if is_part and "requires an argument" in error.message else error.message
    except click.UsageError as error:
        is_help = type(error).__name__ == "NoArgsIsHelpError"  # not in click 8.1, which exits
        return "" if is_part and is_help else error.format_message()
    except click.exceptions.Exit:
        pass  # --help and --version
    return ""


def parse(command: click.Command, name: str, words: list[str], above: click.Context | None) -> None:
    """Parse a command line without running it."""
    context = command.make_context(name, words, parent=above)
    if isinstance(command, SettingsCommand):
        require_effect(resolve_settings(context.params, {}, ()), context.params)
    held = getattr(context, "_protected_args", None)  # click 8.1 has no underscore there
    held = context.protected_args if held is None else held
    if isinstance(command, click.Group) and (left := [*held, *context.args]):
        verb, inner, rest = command.resolve_command(context, left)
        assert verb is not None and inner is not None
        parse(inner, verb, rest, context)


def literals(page: Path) -> Iterator[str]:
    """The lines of a manual that are typed, continued ones joined."""
    text = page.read_text().replace("\\e\n", "")
    for block in re.findall(r"^\.Bd -literal.*\n((?:.*\n)*?)^\.Ed", text, flags=re.MULTILINE):
        yield from re.findall(r"^(?:[$#] )?((?:doractl|eval) .*)$", plain(block), re.MULTILINE)
    for cell in re.findall(r"^\.It .* Ta (.*)$", plain(text), flags=re.MULTILINE):
        yield from re.findall(r"doractl [^,;]*", cell)


def plain(text: str) -> str:
    for escape, character in ROFF.items():
        text = text.replace(escape, character)
    return text


def test_what_is_found() -> None:
    line = (
        """eval "$(doractl env)"; doractl list -o json | jq '.[] | .x' && doractl why 'a b' > x"""
    )
    assert list(commands(line)) == [["env"], ["list", "-o", "json"], ["why", "a b"]]
    assert problem(["strat"]) and problem(["list", "--al"]) and problem(["show"])
    assert not problem(["show"], is_part=True)
    assert problem(["start", "--property"]) and not problem(["start", "--property"], is_part=True)
    assert problem(["node", "begin", "robot"]) and not problem(["--system", "list", "--help"])


@pytest.mark.parametrize("verb", [*sorted(all_verbs()), "node"])
def test_examples_of_help(verb: str) -> None:
    name, _, member = verb.partition(" ")
    command = doractl.get_command(click.Context(doractl), name)
    assert command is not None
    text = command.epilog or ""
    # What follows two blanks explains the example.
    lines = [re.split(r"\s{2,}", one)[0] for one in re.findall(r"\S.*doractl .*|doractl .*", text)]
    assert lines or member
    check(lines)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_examples_of_manuals(page: Path) -> None:
    check(literals(page))
    check(re.findall(r"^\.(?:Ql|Ic) (doractl .*?)[ .,]*$", plain(page.read_text()), re.M), True)


@pytest.mark.parametrize("path", MARKDOWN, ids=lambda path: path.name)
def test_examples_of_texts(path: Path) -> None:
    blocks = re.findall(r"^```\n(.*?)^```", text := path.read_text(), re.DOTALL | re.MULTILINE)
    check(command_of(one.line) for block in blocks for one in typed_lines(block))
    inline = re.findall(r"`([^`]*)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    check(
        (
            " ".join(one.split())
            for one in inline
            if one.startswith("doractl ") and "VERB" not in one
        ),
        True,
    )


@pytest.mark.parametrize("line", ["doractl list  # all", "# all", "true;# all", "echo '#' # all"])
def test_a_comment_too_near_is_named(line: str) -> None:
    """A test that types the line would wait until its end: the comment hides what comes after."""
    with pytest.raises(AssertionError, match="at least three blanks before #"):
        command_of(line)


def test_a_comment_and_what_looks_like_one() -> None:
    assert command_of("doractl list   # all, it's short") == "doractl list"
    for line in ("sed -i '$a # faster' x.py", 'echo "a # b"', "echo a#b $# \\#c"):
        assert command_of(line) == line


@pytest.mark.parametrize("path", TASKS, ids=lambda path: path.stem)
def test_transcripts(path: Path) -> None:
    typed = list(typed_lines(path.read_text()))
    assert path.read_text().startswith("# ")
    wanted = {one.line for one in typed if one.status != 2}
    check(line for line in wanted if "doractl" in line)


def test_there_are_seventeen_transcripts() -> None:
    assert len(TASKS) == 17


def test_commands_in_messages() -> None:
    texts = [text for path in MODULES for text in strings(path.read_text())]
    found = {one for text in [*texts, CATALOG.read_text()] for one in PROSE.findall(text)}
    meant = {one for one in found if one.split()[0] not in NO_VERBS}
    assert len(meant) > 50
    check((f"doractl {one}".replace("{}", "1") for one in sorted(meant)), True)
    assert not {*NO_VERBS} & {*VERBS}


def check(lines: Iterator[str] | Sequence[str], is_part: bool = False) -> None:
    wrong = {
        line: told for line in lines for one in commands(line) if (told := problem(one, is_part))
    }
    assert not wrong
