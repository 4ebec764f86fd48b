"""The entry point of doractl, and the only place that reports its errors."""

import errno
import gc
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import NoReturn

from dora_systemd import __version__
from dora_systemd.cli.edge import asks_for_json, print_error, put_in_place
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input

LIST_VERBS = ("list", "ps", "status")
GARBAGE_OBJECTS = 50_000
"""New objects before the first search for garbage. Most commands end before, with a tenth less CPU:
what they import is no garbage, and Python would search it fifty times."""


def main() -> None:
    """Run doractl, and exit with its status, see ExitCode."""
    status: int = ExitCode.INTERRUPTED
    gc.set_threshold(GARBAGE_OBJECTS)
    with suppress(KeyboardInterrupt):  # one that comes while an error is printed
        put_in_place()
        status = run(sys.argv[1:])
    _leave(status)


def _leave(status: int) -> NoReturn:
    """Exit without finalizing the interpreter, a tenth of the time of a short command."""
    threading = sys.modules.get("threading")
    if threading and threading.active_count() > 1:
        sys.exit(status)  # it waits for the threads
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):
            stream.flush()
    os._exit(status)


def run(arguments: list[str], dispatch: Callable[[list[str]], int] | None = None) -> int:
    """Run doractl, and print its errors in two lines or as JSON; return the exit status.

    dispatch: carries out the arguments.
    """
    try:
        status = (dispatch or _dispatch)(arguments)
        sys.stdout.flush()
        return status
    except DoraSystemdError as error:
        problem = error
    except BrokenPipeError:
        # The reader of our output is gone.
        _give_up_output()
        return ExitCode.PIPE_CLOSED
    except OSError as error:
        if error.errno in _OUTPUT_ERRORS:
            _give_up_output()
        problem = _failed(error)
    except KeyboardInterrupt:
        return ExitCode.INTERRUPTED
    except Exception as error:
        if "DORACTL_DEBUG" in os.environ:
            raise
        problem = _mistake_of_ours(error)
    print_error(problem, asks_for_json(arguments))
    return problem.code


def _failed(error: OSError) -> DoraSystemdError:
    what = "write output" if error.errno in _OUTPUT_ERRORS else "continue"
    # A file may be known by its descriptor, and an error without a number has its own words.
    file = error.filename if isinstance(error.filename, str) else ""
    if error.errno == errno.ENOENT and not file and not _has_directory():
        hint = "cd to a directory that exists"
        return bad_input("cannot continue: the current directory was removed", hint)
    reason = error.strerror or str(error) or type(error).__name__
    return DoraSystemdError(f"cannot {what}: {reason}", file)


def _has_directory() -> bool:
    """Whether the current directory exists."""
    with suppress(OSError):
        return bool(Path.cwd())
    return False


def _mistake_of_ours(error: Exception) -> DoraSystemdError:
    what = f"internal error in doractl ({type(error).__name__}: {error})"
    return DoraSystemdError(what, "please report it; DORACTL_DEBUG=1 shows where it happened")


_OUTPUT_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def _give_up_output() -> None:
    """Discard buffered output: writing it at exit would fail again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _dispatch(arguments: list[str]) -> int:
    """Frequent commands run without click, whose import takes longer than they do."""
    # For completion, the shell runs doractl without arguments.
    if not arguments and (instruction := os.environ.get("_DORACTL_COMPLETE")):
        from dora_systemd.cli.completion import complete

        return complete(instruction)
    if arguments in (["--version"], ["-V"]):
        print(f"doractl {__version__}")
        return ExitCode.OK
    if arguments and arguments[0] in LIST_VERBS:
        from dora_systemd.cli.listing import parse_list, print_dataflows

        if (request := parse_list(arguments[1:])) is not None:
            return print_dataflows(request)
    from dora_systemd.cli.group import run_verb

    if may_name_hosts(arguments):
        # As a verb: by its name, because it is above this module.
        elsewhere = import_module("dora_systemd.cli.remote.dispatch")
        status: int = elsewhere.run_elsewhere(arguments)
        return status
    return run_verb(arguments)


def may_name_hosts(words: list[str]) -> bool:
    """Whether a command line may have -H: others need nothing of what follows from it."""
    return any(word[:1] == "-" and ("H" in word or word.startswith("--host")) for word in words)


if __name__ == "__main__":
    main()
