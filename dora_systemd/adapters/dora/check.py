"""Runs dora's own checks of a dataflow inside the cell, in parallel to its start.

doractl does not run dora: that may be the user's own version, or another program in its place. Here
the user runs it, in the sandbox, with the environment of the nodes.
"""

import contextlib
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from dora_systemd.adapters.dora.command import dora_version, find_dora, refusal_reason, run_dora
from dora_systemd.adapters.host.files import parse_yaml, read_text
from dora_systemd.adapters.host.process import beside
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.dataflow import parse_dataflow, unset_variables
from dora_systemd.decisions.dora.errors import UNNAMED, UNSET, UNSET_OR_OTHER, name_input
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.trust.programs import own_account
from dora_systemd.trust.sight import cannot_reach

T = TypeVar("T")


class DoraCheck:
    """Starts the checks when it is created. They run in parallel because each starts a process.

    environment: that of the nodes. listens: waits for a coordinator of this dora, and returns
    whether it listens. Then no process is started for the version: OLDEST_DORA was the first one
    with the arguments of coordinator_command().
    """

    def __init__(
        self,
        options: RunnerOptions,
        environment: Mapping[str, str],
        listens: Callable[[], bool] = lambda: False,
    ) -> None:
        def check_version() -> str:
            return "" if listens() else dora_version(options.dora, own_account(), environment)

        def check_dataflow() -> str:
            # A member has the file of its head and the same dora, which accepted the file there.
            return "" if options.machine else refusal_of_dora(options, environment)

        self._options = options
        self._version = beside(check_version)
        self._refusal = beside(check_dataflow)

    def beside(self, call: Callable[[], T]) -> T:
        """Call `call`, which reads the dataflow, in parallel with the checks; return its result.

        An error of `call` takes precedence over that of dora about the same file: doractl reports
        that error before a start, too. Without access to the file, or without dora, that is the
        error; but not if the file is missing, for dora may be missing with the whole project.
        """
        try:
            found = call()
        except DoraSystemdError:
            if _is_missing(self._options.dataflow):
                raise
            check_access(self._options)
            self.version()
            raise
        self.result()
        return found

    def version(self) -> str:
        """Wait for the version of dora, "" for one that listens. Raises DoraSystemdError."""
        return self._version.result()

    def result(self) -> None:
        """Wait for all checks. Raises DoraSystemdError for what is refused.

        If several fail, the first refusal in the order of the code is reported.
        """
        options = self._options
        check_access(options)
        self.version()
        if reason := self._refusal.result():
            hint = f"see {options.dora} validate {options.dataflow}"
            if f"{UNSET}: " in reason:  # at a prompt it may be set
                hint = "set the variable by --env NAME=VALUE, or write ${NAME:-DEFAULT}"
            raise bad_input(f"cannot use {options.dataflow}: {reason}", hint)


def refusal_of_dora(options: RunnerOptions, environment: Mapping[str, str]) -> str:
    """The error of `dora validate` for the dataflow of `options`, or "".

    environment: that of the nodes.
    """
    arguments = ["validate", options.dataflow]
    directory = options.working_directory
    done = run_dora(options.dora, arguments, own_account(), environment, directory)
    if done.status == 0:
        return ""
    reason = refusal_reason(done)
    if UNSET_OR_OTHER in reason and (names := _unset(options.dataflow, environment)):
        return reason.replace(UNSET_OR_OTHER, f"{UNSET}: {', '.join(names)}")
    return name_input(reason, _document(options.dataflow)) if re.search(UNNAMED, reason) else reason


def _unset(dataflow: str, environment: Mapping[str, str]) -> list[str]:
    with contextlib.suppress(DoraSystemdError):
        return unset_variables(parse_dataflow(_document(dataflow), dataflow), environment)
    return []


def _document(dataflow: str) -> object:
    path = Path(dataflow)
    with contextlib.suppress(DoraSystemdError):
        return parse_yaml(read_text(path), path)
    return None


def check_access(options: RunnerOptions) -> None:
    """Raise DoraSystemdError (NO_PERMISSION) for the first path that this user cannot access.

    A missing dora is NO_DORA; reading a missing dataflow reports that itself.
    """
    places = (options.working_directory, options.dora)
    wanted = [(options.dataflow, os.R_OK), *((one, os.X_OK) for one in places)]
    for path, mode in wanted:
        if not os.access(path, mode) and not _is_missing(path):
            raise cannot_reach(own_account().name, path)
    find_dora(options.dora, None, "")


def _is_missing(path: str) -> bool:
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        return False
    return False
