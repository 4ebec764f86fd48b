"""`doractl machine add`, `list`, `check` and `remove`.

The key of a machine only allows a link to log in and to run its part, see AUTHORIZED_KEYS FILE
FORMAT in sshd(8). sshd runs the forced command, and puts the command that the link requested into a
variable.
"""

import os
import re
import shlex
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from stat import S_IMODE

from dora_systemd.adapters.host.files import decoded, parse_yaml, write_atomic
from dora_systemd.adapters.host.process import run_command
from dora_systemd.decisions.cell.machines import parse_machine
from dora_systemd.decisions.machines.description import problems, required
from dora_systemd.decisions.machines.member import parse_entry, with_machine, without_machine
from dora_systemd.decisions.machines.wire import PORT_RANGE
from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.decisions.settings.machines import MACHINES
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input, usage_error
from dora_systemd.scope import Scope
from dora_systemd.trust.files import read_file
from dora_systemd.trust.paths import exists
from dora_systemd.trust.programs import own_account
from dora_systemd.values import as_mapping, quoted, shown
from dora_systemd.verbs.machines.probe import Probe, probe_as_caller, probe_as_link, run_there
from dora_systemd.verbs.start.read import config_file, key_place
from dora_systemd.verbs.start.settings import read_config
from dora_systemd.verbs.version import own_facts

ORIGINAL = "SSH_ORIGINAL_COMMAND"
_SHELL = 5
"""The words before the mark, see remote_command(): exec sh -c SCRIPT doractl."""
_PUBLIC = r"ssh-[a-z0-9-]+ [A-Za-z0-9+/=]+"
_MARK = r"[a-z]+-[0-9a-f]{32}"


def authorized_line(program: str, public: str, comment: str) -> str:
    """The line for authorized_keys. program: absolute path of doractl on that machine.

    Forwards are for the ports of links on 127.0.0.1 only. Raises DoraSystemdError (BAD_INPUT) for
    what is no public key, and for a path that cannot stand there.
    """
    if not re.fullmatch(r"/[A-Za-z0-9_./+-]+", program):
        raise bad_input(f"cannot use {quoted(program)} there as doractl", "link it into /usr/bin")
    key = _public(public)
    # sshd(8) has no ranges there, and * would be each service that listens on that machine.
    only = ",".join(
        f'{option}="127.0.0.1:{port}"'
        for option in ("permitlisten", "permitopen")
        for port in PORT_RANGE
    )
    forced = f'command="{program} member"'
    return f"restrict,port-forwarding,{only},{forced} {key} {comment}"


def key_text(public: str) -> str:
    """Return the unique part of a public key, or raise DoraSystemdError (BAD_INPUT)."""
    return _public(public).split()[1]


def _public(text: str) -> str:
    """The key without its comment."""
    found = re.match(_PUBLIC, text)
    if not found:
        raise bad_input("cannot read the public key", "see ssh-keygen(1)")
    return found[0]


def forced_words(original: str) -> tuple[str, list[str]]:
    """Parse the command that the link requested: the mark to print, the arguments of doractl.

    Raises DoraSystemdError (USAGE) for everything that is no part of a dataflow.
    """
    try:
        words = shlex.split(original)
    except ValueError as error:
        raise _not_allowed() from error
    mark, *arguments = words[_SHELL:] or [""]
    if not re.fullmatch(_MARK, mark) or arguments[:1] != ["member"]:
        raise _not_allowed()
    return mark, arguments[1:]


def _not_allowed() -> DoraSystemdError:
    return usage_error("this key can only run parts of dataflows", "log in with another key")


_INSTALL = (
    'umask 077; mkdir -p "$HOME/.ssh" && f="$HOME/.ssh/authorized_keys" && touch "$f" && '
    '{ [ -z "$(tail -c1 "$f")" ] || echo >>"$f"; } && '
    '{ grep -qF "$1" "$f" || printf "%s\\n" "$2" >>"$f"; }'
)
_REMOVE = (
    'f="$HOME/.ssh/authorized_keys"; [ -f "$f" ] || exit 0; umask 077; '
    # grep has the status 1 if no line is left, and 2 if it cannot read or write.
    'grep -vF "$1" "$f" >"$f.doractl"; [ $? -le 1 ] && mv "$f.doractl" "$f"'
)
_NEW_MODE = 0o644


@dataclass(frozen=True)
class Known:
    """A machine of a config.yml."""

    name: str
    host: Host
    key: str  # the file of its own key, or "" for the keys of the caller


def known_machines(scope: Scope, environment: Mapping[str, str]) -> list[Known]:
    """Read all machines of the settings files. Raises DoraSystemdError."""
    settings = read_config(scope, environment)
    source = settings.source(MACHINES)
    found = (
        parse_entry(name, declared, source, "/dataflow.yml")
        for name, declared in settings[MACHINES].items()
    )
    place = key_place(scope, environment)
    return [Known(one.name, one.host, _key(place, one.name)) for one in found]


def chosen(machines: list[Known], names: tuple[str, ...]) -> list[Known]:
    """Return the machines with these names, or all. Raises DoraSystemdError (NOT_FOUND)."""
    by_name = {one.name: one for one in machines}
    for name in names:
        if name not in by_name:
            hint = f"machines: {', '.join(by_name)}" if by_name else "see doractl machine add"
            raise DoraSystemdError(f"no machine named {quoted(name)}", hint, ExitCode.NOT_FOUND)
    return [by_name[name] for name in names] if names else machines


def check_machine(scope: Scope, machine: Known) -> tuple[Probe, list[tuple[str, str]]]:
    """Probe a machine with the login of its link; return the result and its problems.

    Raises DoraSystemdError.
    """
    probe = probe_as_link(machine.host, machine.name, machine.key)
    return probe, list(problems(own_facts(scope), probe.facts, probe.skew))


def add_machine(
    scope: Scope, environment: Mapping[str, str], host: Host, name: str
) -> Iterator[str]:
    """Create a key, authorize it on the host, and declare the machine; yield each step done.

    Raises DoraSystemdError; then nothing is declared.
    """
    parse_machine(name)
    if any(one.name == name for one in known_machines(scope, environment)):
        hint = f"doractl machine check {name}, or choose another --name"
        message = f"cannot add machine {name}: there is one of that name"
        raise DoraSystemdError(message, hint, ExitCode.NAME_IN_USE)
    file = config_file(scope, environment)
    text = _with(file, name, host)
    found = probe_as_caller(host)
    required(problems(own_facts(scope), found.facts, found.skew), name)
    key = make_key(key_place(scope, environment), name)
    public = public_key(key)
    line = authorized_line(found.facts.program, public, _comment(name))
    run_there(host, _INSTALL, key_text(public), line)
    yield f"Key {key} may run parts of dataflows there as {found.facts.user}"
    probe_as_link(host, name, str(key))
    _write(file, text)
    yield f"Machine added: {name} ({host.text}), in {file}"


def remove_machine(
    scope: Scope, environment: Mapping[str, str], machine: Known, is_forced: bool = False
) -> Iterator[str]:
    """Undo add_machine(); yields what was done.

    is_forced: also if the machine keeps the line with its key. Raises DoraSystemdError; then
    nothing is removed.
    """
    file = config_file(scope, environment)
    text = _without(file, machine.name)
    if machine.key:
        try:
            run_there(machine.host, _REMOVE, key_text(public_key(Path(machine.key))))
        except DoraSystemdError as error:
            if not is_forced:
                raise _not_removed(machine, error) from error
            line = f"delete the line that ends in {_comment(machine.name)} there"
            yield f"~/.ssh/authorized_keys of {machine.host.text} still has its key: {line}"
        remove_key(Path(machine.key))
    _write(file, text)
    yield f"Machine removed: {machine.name} ({machine.host.text})"


def _comment(name: str) -> str:
    """The end of the line in authorized_keys."""
    return f"dora-systemd:{name}"


def _not_removed(machine: Known, error: DoraSystemdError) -> DoraSystemdError:
    message = f"cannot remove the key of machine {machine.name} there: {error.message}"
    hint = f"try again later, or forget it here: doractl machine remove --force {machine.name}"
    return DoraSystemdError(message, hint, error.code)


def _key(place: Path, name: str) -> str:
    path = place / name
    return str(path) if exists(path) else ""


def _with(file: Path, name: str, host: Host) -> str:
    before = _text(file)
    text = with_machine(before, name, host.text)
    return _checked(file, before, text, name, added=host.text)


def _without(file: Path, name: str) -> str:
    before = _text(file)
    return _checked(file, before, without_machine(before, name), name)


def _checked(file: Path, before: str, text: str | None, name: str, added: str = "") -> str:
    """The new text, if YAML reads exactly this change from it. Raises DoraSystemdError."""
    wanted = dict(_document(file, before))
    machines = dict(as_mapping(wanted.get("machines")))
    if added:
        machines[name] = {"host": added}
    else:
        machines.pop(name, None)
    wanted = {key: value for key, value in wanted.items() if key != "machines"}
    wanted |= {"machines": machines} if machines else {}
    if text is None or file.is_symlink() or _document(file, text) != wanted:
        what = f"write {name}: {{host: {added}}} below" if added else f"remove {name} below"
        raise bad_input(f"cannot change {shown(str(file))} by itself", f"{what} machines: there")
    return text


def _document(file: Path, text: str) -> dict[str, object]:
    found = as_mapping(parse_yaml(text, file, allow_empty=True))
    return {str(key): value for key, value in found.items()}


def _text(file: Path) -> str:
    return decoded(read_file(file).data, file) if exists(file) else ""


def _write(file: Path, text: str) -> None:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        message = f"cannot create {file.parent}: {error.strerror}"
        raise DoraSystemdError(message, "", ExitCode.NO_PERMISSION) from error
    # It may have secrets, such as values of env.
    mode = S_IMODE(read_file(file).place.mode) if exists(file) else _NEW_MODE
    write_atomic(file, text, mode, is_durable=True)


_KEY_SECONDS = 30.0


def make_key(place: Path, machine: str) -> Path:
    """Create the key of a machine, unless it exists; return its path. Raises DoraSystemdError."""
    path = place / machine
    if exists(path):
        return path
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        code = ExitCode.NO_PERMISSION if isinstance(error, PermissionError) else ExitCode.FAILURE
        raise DoraSystemdError(f"cannot create {place}: {error.strerror}", "", code) from error
    words = ("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", f"dora-systemd {machine}")
    done = run_command((*words, "-f", str(path)), _KEY_SECONDS, os.environ, None, own_account())
    if done.status:
        words_of_it = (done.stderr or done.stdout).strip().splitlines()[-1:]
        raise DoraSystemdError(f"cannot make the key {path}: {''.join(words_of_it)}")
    return path


def public_key(path: Path) -> str:
    """The public part of a key."""
    public = path.with_name(f"{path.name}.pub")
    return decoded(read_file(public).data, public).strip()


def remove_key(path: Path) -> None:
    """Remove both parts of a key."""
    for one in (path, path.with_name(f"{path.name}.pub")):
        with suppress(FileNotFoundError):
            one.unlink()
