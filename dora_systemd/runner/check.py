"""Reports what a runner would refuse: `python3 -m dora_systemd.runner.check`.

`doractl start --dry-run` runs it with the runner's arguments. It prints the refusal and exits with
the runner's exit status; otherwise it prints the versions of dora and of the nodes' Python. It
starts nothing but dora's own checks and that Python.
"""

import sys
from collections.abc import Mapping

from dora_systemd.adapters.dora.check import DoraCheck
from dora_systemd.adapters.dora.command import python_version
from dora_systemd.adapters.dora.preparation import Prepared, prepare
from dora_systemd.decisions.cell.launch import python_of
from dora_systemd.decisions.cell.options import RunnerOptions, parse_runner_argv
from dora_systemd.decisions.life.refusal import format_refusal, refusal_exit
from dora_systemd.decisions.releases.program_versions import format_versions
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.begin import nodes_environment
from dora_systemd.runner.nodes.rights import check_first


def check_start(
    options: RunnerOptions, own: RunnerOptions, environment: Mapping[str, str]
) -> tuple[DoraCheck, Prepared]:
    """Read and check the dataflow of `options` as at a start. Raises DoraSystemdError.

    own: the options for the nodes of this machine. environment: of the nodes.
    """
    check = DoraCheck(options, environment)
    prepared = check.beside(lambda: prepare(options, environment))
    check_first(own)
    return check, prepared


def main(argv: list[str]) -> int:
    """Check the dataflow that `argv` describes; the exit status of a runner."""
    try:
        options = parse_runner_argv(argv)
        environment = nodes_environment(options.working_directory)
        check, prepared = check_start(options, options, environment)
        python = python_version(python_of(prepared.plan), environment)
        print(format_versions({"dora": check.version(), "python": python}))
    except DoraSystemdError as error:
        print(format_refusal(error))
        return refusal_exit(error)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
