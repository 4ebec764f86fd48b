"""The command line of the lab as a value."""

import argparse
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lab.definition import PLATFORMS
from lab.errors import LabError

FOREIGN = "arm64"
"""The processor whose programs can be run on this one, too."""

_CONTAINERS = ("rivals", "browser", "openarm", "machines")
FORMS = ("container", "vm", "emulator", *PLATFORMS, FOREIGN, *_CONTAINERS)

MACHINES = ("vm", "emulator")

REBOOT = "--reboot--"

EPILOG = """\
environment:
  LAB=container     a systemd-nspawn container (default): starts in half a second;
                    systemd accepts limits there but cannot enforce them
  LAB=vm            a machine with a kernel of its own, as a process, and cgroup v2 controllers
  LAB=emulator      an emulated machine with Debian's kernel: PSI, cpusets, two processors
  LAB=bookworm      a container with Debian 12: systemd 252, Python 3.11; the checkout is not
                    installed, but all that its packages need is
  LAB=forky         a container with Debian forky, as bookworm: systemd 262, Python 3.14
  LAB=arm64         a container with Debian 13 for arm64, each program of which is emulated: slow
  LAB=rivals        the container with supervisord, circus and pm2, for benchmarks
  LAB=browser       the container with Chromium, for the status page
  LAB=openarm       the container with nodes of OpenArm from PyPI
  LAB=machines      three containers, a b c, on a network with sshd; the command runs in a
  LAB_OUT=DIR       this directory is /out inside
  DORA_LAB_CACHE    where images are kept (default: ~/.cache/dora-systemd-lab)
  LAB_MIRROR        another Debian mirror for building the image
  LAB_SPEED=50      gives the virtual machine half of its time, to try tests on a slow one

The command runs as root in a private copy of the checkout, /src; what it writes
there is gone afterwards. Inside, LAB names the form. The exit status is the
command's, 128+N if signal N killed it, 125 if the lab itself failed.
CMD1 --reboot-- CMD2 restarts the system in between, if CMD1 succeeds; not with LAB=machines.
"""


@dataclass(frozen=True)
class Options:
    verb: str
    form: str
    # Between two of them the system is rebooted.
    commands: tuple[tuple[str, ...], ...] = ()
    env: tuple[tuple[str, str], ...] = ()
    out: Path | None = None
    # The command restarts the machine by itself, and runs again after each boot until it exits.
    cuts: bool = False


def parse_options(arguments: Sequence[str], environ: Mapping[str, str] = os.environ) -> Options:
    given = build_parser().parse_args(arguments)
    form = parse_form(environ.get("LAB") or FORMS[0])
    if getattr(given, "cuts", False) and form not in MACHINES:
        raise LabError("cut the power of a container", "LAB=vm")
    return Options(
        verb=given.verb,
        form=form,
        commands=parse_commands(given.verb, getattr(given, "command", [])),
        env=tuple(parse_variable(text, environ) for text in getattr(given, "env", [])),
        out=parse_out(environ.get("LAB_OUT", "")),
        cuts=getattr(given, "cuts", False),
    )


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="lab",
        description="Run a command under a booted systemd, with dora and this checkout.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    run = verbs.add_parser("run", help="run a command in a fresh system: run [--env K[=V]] -- CMD")
    shell = verbs.add_parser("shell", help="a root shell in a fresh system")
    verbs.add_parser("build", help="build what is missing of the image")
    verbs.add_parser("clean", help="remove all images and what killed runs left behind")
    verbs.add_parser("sweep")  # no help: for the lab itself
    for verb in (run, shell):
        verb.add_argument(
            "--env",
            action="append",
            default=[],
            metavar="NAME[=VALUE]",
            help="set a variable for the command; without a value, the caller's",
        )
    run.add_argument(
        "--cuts", action="store_true", help="CMD cuts the power: run it again after each boot"
    )
    run.add_argument("command", nargs=argparse.REMAINDER, metavar="CMD")
    return parser


def parse_form(text: str) -> str:
    if text not in FORMS:
        raise LabError(f"use LAB={text}", f"one of {', '.join(FORMS)}")
    return text


def parse_commands(verb: str, words: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    if verb == "shell":
        return (("/bin/bash", "--login"),)
    commands: list[list[str]] = [[]]
    for word in words[1:] if words[:1] == ["--"] else words:
        if word == REBOOT:
            commands.append([])
        else:
            commands[-1].append(word)
    if verb == "run" and not all(commands):
        raise LabError("run nothing", "lab run -- CMD")
    return tuple(tuple(command) for command in commands)


def parse_variable(text: str, environ: Mapping[str, str]) -> tuple[str, str]:
    name, separator, value = text.partition("=")
    if not name.isidentifier() or not name.isascii():
        raise LabError(f"pass the variable {name!r}", "--env NAME or --env NAME=VALUE")
    return name, value if separator else environ.get(name, "")


def parse_out(text: str) -> Path | None:
    if not text:
        return None
    path = Path(text).absolute()
    if not path.is_dir():
        raise LabError(f"use LAB_OUT={text}", "an existing directory")
    return path
