"""Exit statuses of a unit whose process systemd could not execute, see systemd.exec(5)."""

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
    """What systemd could not do before it executed a process, "" for another exit status.

    As "its sandbox could not be set up (exit code 226/NAMESPACE)".
    """
    if not 0 <= status - _FIRST < len(_NAMES):
        return ""
    name = _NAMES[status - _FIRST]
    return f"{_WORDS.get(name, _OTHER)} (exit code {status}{'' if name == '-' else f'/{name}'})"
