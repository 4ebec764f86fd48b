"""Why a unit did not start: the runner refused it, or systemd could not execute the runner.

A runner passes its refusal to doractl by its exit status, and by STATUS= of its unit. With
NotifyAccess=main only the runner can set STATUS=, and it refuses before nodes run. But a user may
have another program in the runner's place, so the text is cleaned and cut, and is only printed.
"""

from dora_systemd.decisions.cell.status import FAILED_BECAUSE
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.errors import DoraSystemdError, ExitCode, RestartsSpent, TimedOut
from dora_systemd.terminal_text import short_line

_HINT = "; hint: "
_LONGEST = 1500
"""Maximum bytes of message and hint each: systemd accepts 4096 bytes in a notification."""
_CODES = {
    RunnerExit.BAD_DATAFLOW: ExitCode.BAD_INPUT,
    RunnerExit.NO_ACCESS: ExitCode.NO_PERMISSION,
    RunnerExit.NO_DORA: ExitCode.NO_DORA,
    RunnerExit.NO_MACHINE: ExitCode.NO_HOST,
}


def refusal_exit(error: DoraSystemdError) -> RunnerExit:
    """The runner's exit status for an error; with that of a check without an answer, it restarts.

    A machine that boots may be too busy for one.
    """
    if isinstance(error, TimedOut):
        return RunnerExit.FAILED
    if isinstance(error, RestartsSpent):
        return RunnerExit.RESTARTS_SPENT
    return next(
        (status for status, code in _CODES.items() if code is error.code), RunnerExit.BAD_DATAFLOW
    )


def format_refusal(error: DoraSystemdError) -> str:
    """STATUS= of a runner that refuses its dataflow."""
    hint = f"{_HINT}{short_line(error.hint, _LONGEST)}" if error.hint else ""
    return f"{FAILED_BECAUSE}{short_line(error.message, _LONGEST)}{hint}"


def without_hint(text: str) -> str:
    """STATUS= of a runner, without the hint of a refusal."""
    return text.partition(_HINT)[0]


def parse_refusal(text: str, status: int) -> DoraSystemdError | None:
    """The error that a runner has ended with, None for any other end.

    text: its last STATUS=. status: its exit status.
    """
    if status not in list(_CODES) or not text.startswith(FAILED_BECAUSE):
        return None
    message, _, hint = text.removeprefix(FAILED_BECAUSE).partition(_HINT)
    return DoraSystemdError(
        short_line(message, _LONGEST), short_line(hint, _LONGEST), _CODES[RunnerExit(status)]
    )


_FIRST = 200
_NAMES = (
    *("CHDIR", "NICE", "FDS", "EXEC", "MEMORY", "LIMITS", "OOM_ADJUST", "SIGNAL_MASK", "STDIN"),
    *("STDOUT", "CHROOT", "IOPRIO", "TIMERSLACK", "SECUREBITS", "SETSCHEDULER", "CPUAFFINITY"),
    *("GROUP", "USER", "CAPABILITIES", "CGROUP", "SETSID", "CONFIRM", "STDERR", "-", "PAM"),
    *("NETWORK", "NAMESPACE", "NO_NEW_PRIVILEGES", "SECCOMP", "SELINUX_CONTEXT", "PERSONALITY"),
    *("APPARMOR", "ADDRESS_FAMILIES", "RUNTIME_DIRECTORY", "-", "CHOWN", "SMACK_PROCESS_LABEL"),
    *("KEYRING", "STATE_DIRECTORY", "CACHE_DIRECTORY", "LOGS_DIRECTORY"),
    *("CONFIGURATION_DIRECTORY", "NUMA_POLICY", "CREDENTIALS", "BPF", "KSM"),
)
_OTHER = "systemd could not start its process"
_WORDS = {
    "CHDIR": "its working directory could not be entered",
    "NICE": "the nice value was refused",
    "EXEC": "its program could not be executed",
    "GROUP": "its group could not be set up",
    "USER": "its user, or the user namespace of its sandbox, could not be set up",
    "CGROUP": "its cgroup could not be set up",
    "NAMESPACE": "its sandbox could not be set up",
    "CREDENTIALS": "a credential could not be read",
    "SETSCHEDULER": "realtime scheduling was refused, see LimitRTPRIO= in systemd.exec(5)",
}


def setup_failure(status: int) -> str:
    """Return what systemd could not do before it executed a process, "" for another exit status.

    As "its sandbox could not be set up (exit code 226/NAMESPACE)".
    """
    if not 0 <= status - _FIRST < len(_NAMES):
        return ""
    name = _NAMES[status - _FIRST]
    return f"{_WORDS.get(name, _OTHER)} (exit code {status}{'' if name == '-' else f'/{name}'})"


NOT_EXECUTED = setup_failure(203)
"""The words for a program that does not exist, or that its user may not execute."""
