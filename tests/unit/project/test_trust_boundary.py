"""Nobody opens, stats, runs or connects around dora_systemd.trust: held over the syntax tree.

A module that reaches the outside world is in TABLE, with the reason why nobody but root (or the
account itself) can have put there what it finds. Whatever may be somebody else's goes through
`trust`. A new line in the table is a decision about trust: read "WHO TRUSTS WHOM"
in dora-systemd-security(7) first.
"""

import ast

from tests.unit.checkout import module_paths, nodes_of

MODULES = {
    "os": "open stat lstat access listdir scandir readlink unlink remove rename replace mkdir "
    "rmdir chmod chown symlink link execv execve execvp execvpe posix_spawn system popen fdopen "
    "walk",
    "shutil": "which copy copy2 copyfile copytree rmtree move",
    "subprocess": "run Popen call check_call check_output",
    "socket": "create_connection",
    "asyncio": "create_subprocess_exec create_subprocess_shell open_unix_connection "
    "open_connection",
}
_TESTS = "exists lexists isdir isfile islink ismount getsize getmtime samefile realpath"
ON_PATHS = set(_TESTS.split())
"""Of os.path."""
CALLS = {(module, name) for module, names in MODULES.items() for name in names.split()}
_METHODS = """
read_text read_bytes write_text write_bytes open touch unlink rmdir resolve readlink
stat lstat exists is_file is_dir is_socket is_fifo is_symlink owner samefile
iterdir glob rglob connect connect_ex
"""
METHODS = set(_METHODS.split())
"""Of pathlib.Path and of sockets; of whatever else bears such a name, too."""

DOOR = "is the door"
OWN = "reads for the caller; what may be another's comes through trust before it gets here"
KERNEL = "reads what the kernel writes: /sys/fs/cgroup, /proc"
ROOTS = "places of root's, or in user scope of the caller's: units, journal, bus, /run/dora-systemd"
INSTALLED = "what is installed with us"
CELL = "runs in a cell, as the user of the dataflow"
OTHERWISE = (
    "the name means something else here: what is asked is a sight, or a connection of trust's"
)

_TABLE = {
    DOOR: """
        trust.courier trust.eyes trust.files trust.locks trust.owned trust.paths
        trust.project trust.programs trust.rings trust.scribe
        trust.sight trust.sockets trust.terminals trust.tree
    """,
    OWN: """
        adapters.dora.preparation adapters.host.files adapters.ssh cli.main
        adapters.bundles.reader
        cli.edge cli.verbs.look.logs decisions.cell.launch verbs.inhibit
        verbs.machines.member verbs.machines.push verbs.start.limits verbs.start.startable
        verbs.start.where
    """,
    KERNEL: """
        adapters.cgroup.groups adapters.host.clients
        adapters.host.rivals
        adapters.host.process_table adapters.host.real_time adapters.host.rights
        runner.cell.restarts verbs.destroy
        link.relay verbs.facts.host verbs.facts.lives verbs.facts.stack verbs.start.programs
        verbs.start.sandbox
    """,
    ROOTS: """
        adapters.bus.connection adapters.host.unit_files
        adapters.host.guard
        adapters.bundles.store
        adapters.releases.draft adapters.releases.transfer
        adapters.releases.store verbs.releases.source verbs.releases.trial
        adapters.journal.journalctl adapters.journal.reader adapters.journal.socket verbs.doctor
        verbs.facts.enabled verbs.facts.locks verbs.follow verbs.gateway verbs.start.needs
        verbs.machines.register
        scope verbs.logs verbs.setup verbs.show verbs.start.enable verbs.up
    """,
    INSTALLED: """
        cli.group gateway.routes
    """,
    CELL: """
        adapters.dora.check adapters.dora.engine adapters.dora.websocket adapters.host.fd_store
        adapters.host.notify_socket runner.owes.watch
        adapters.host.watch adapters.logs.held adapters.logs.jsonl adapters.logs.pipes
        adapters.runner_socket.door
        adapters.runner_socket.listener adapters.runner_socket.relay runner.cell.begin
        runner.cell.restarts runner.machines.boot
        adapters.host.presence runner.requests runner.needs runner.nodes.launcher_gates
        runner.cell.engine runner.cell.notices runner.cell.pump runner.machines.head
        runner.machines.roster runner.main runner.nodes.nodes
        runner.recorder.keep runner.recorder.record
        runner.owes.listen runner.reload.settings_file runner.reload.sources runner.stop_post
    """,
    OTHERWISE: """
        adapters.dora.control adapters.host.addresses verbs.node
    """,
}
TABLE = {name: reason for reason, names in _TABLE.items() for name in names.split()}
"""Why a module may reach the outside world by itself."""


def calls(name: str) -> set[str]:
    """The calls of a module that reach the outside world."""
    found = {_reach(node) for node in nodes_of(name) if isinstance(node, ast.Call)}
    return found - {""}


def _reach(node: ast.Call) -> str:
    function = node.func
    if isinstance(function, ast.Name):
        return function.id if function.id == "open" else ""
    if not isinstance(function, ast.Attribute):
        return ""
    if ast.unparse(function.value) == "os.path":
        return f"os.path.{function.attr}" if function.attr in ON_PATHS else ""
    owner = function.value.id if isinstance(function.value, ast.Name) else ""
    if (owner, function.attr) in CALLS:
        return f"{owner}.{function.attr}"
    return f".{function.attr}" if function.attr in METHODS and owner not in MODULES else ""


def test_nobody_goes_around_the_door() -> None:
    found = {name: calls(name) for name in module_paths().keys() - TABLE.keys()}
    around = {name: reached for name, reached in found.items() if reached}
    assert not around, "it must go through dora_systemd.trust"


def test_every_exception_is_needed() -> None:
    gone = TABLE.keys() - module_paths().keys()
    assert not gone, "there is no such module: take it out of the table"
    idle = {name for name in TABLE if not calls(name)}
    assert not idle, "it reaches nothing any more: take it out of the table"
