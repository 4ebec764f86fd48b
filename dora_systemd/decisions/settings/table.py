"""The settings of a dataflow, one declaration each.

Flags, keys of settings files, environment variables and manual entries are derived from this table
or checked against it. A new setting is one more assignment.
"""

from collections.abc import Mapping
from typing import Any

from dora_systemd.decisions.cell.options import DEFAULT_GRACE
from dora_systemd.decisions.settings.kinds import (
    BOOL,
    DURATION,
    ENVIRONMENT,
    PATH,
    PATHS,
    PROGRAM,
    PROPERTIES,
    TEXT,
    Setting,
)
from dora_systemd.decisions.settings.limits import LIMIT_SETTINGS, LIVE_SETTINGS, LOG_RATE_LIMIT
from dora_systemd.decisions.settings.machines import MACHINE_SETTINGS
from dora_systemd.decisions.settings.needs import NEED_SETTINGS
from dora_systemd.decisions.settings.nodes import nodes_setting
from dora_systemd.decisions.settings.on_failure import NOTICE_SETTINGS
from dora_systemd.decisions.settings.owes import OWES_SETTINGS, SIGN_SETTINGS
from dora_systemd.decisions.settings.record import RECORD_SETTINGS
from dora_systemd.decisions.settings.reload import RELOAD_SETTINGS
from dora_systemd.decisions.settings.restarts import RESTART_SETTINGS
from dora_systemd.decisions.settings.rights import RIGHTS_SETTINGS
from dora_systemd.decisions.settings.sandbox import CREDENTIAL_SETTINGS, SANDBOX_SETTINGS
from dora_systemd.decisions.settings.stops import STOP_SETTINGS

ENV = Setting[Mapping[str, str]]("env", ENVIRONMENT, {}, "Environment variable of all nodes.")
ENV_FILE = Setting[tuple[str, ...]](
    "env_file",
    PATHS,
    (),
    "File with environment variables, as EnvironmentFile= in systemd.exec(5).",
    metavar="FILE",
)
VENV = Setting[str | None](
    "venv", PATH, None, "Virtual environment whose Python runs the nodes.", metavar="DIR"
)
UV = Setting[bool]("uv", BOOL, False, "Run the programs of nodes with uv, like dora start --uv.")
DEBUG = Setting[bool]("debug", BOOL, False, "Allow inspection of topics, like dora start --debug.")
WORKING_DIRECTORY = Setting[str | None](
    "working_directory",
    PATH,
    None,
    "Working directory of the nodes and of relative paths; default: that of the dataflow file.",
    metavar="DIR",
)
GRACE_DURATION = Setting[int](
    "grace_duration",
    DURATION,
    DEFAULT_GRACE,
    "Time for a node to exit after it is told to stop; then it is killed.",
)
PROPERTY = Setting[tuple[str, ...]](
    "property",
    PROPERTIES,
    (),
    "Property of the unit, as systemd-run(1) takes it.",
    flags=("--property", "-p"),
    root_only=True,
)
USER = Setting[str | None](
    "user",
    TEXT,
    None,
    "User that the nodes run as; default: the owner of the dataflow file, or dora for root's.",
    flags=("--uid",),
    variable="DORA_UID",
    metavar="USER",
    root_only=True,
)
ALLOW_SHELL_NODES = Setting[bool](
    "allow_shell_nodes", BOOL, False, "Allow nodes with the path 'shell'."
)
EXIT_WHEN_NODES_FINISH = Setting[bool | None](
    "exit_when_nodes_finish",
    BOOL,
    None,
    "End the dataflow when its nodes have finished; default: as in the dataflow file.",
)
DORA = Setting[str]("dora", PROGRAM, "dora", "The dora program to run.", variable="DORA_PROGRAM")

_LIVE = (*LIVE_SETTINGS, LOG_RATE_LIMIT)
CHANGEABLE: tuple[Setting[Any], ...] = (*_LIVE, nodes_setting(_LIVE))
"""Settings that `doractl set` changes while the dataflow is running."""

_SECTIONS: dict[str, tuple[Setting[Any], ...]] = {
    # All settings above, in this order, so that a setting is declared in one place only.
    "Nodes": (
        *(
            value
            for value in list(globals().values())
            if isinstance(value, Setting) and value is not LOG_RATE_LIMIT
        ),
        LOG_RATE_LIMIT,
    ),
    "Needs": NEED_SETTINGS,
    "Limits": LIMIT_SETTINGS,
    "Rights of nodes": RIGHTS_SETTINGS,
    "Restarts": RESTART_SETTINGS,
    "Stop": STOP_SETTINGS,
    "Signs of life": SIGN_SETTINGS,
    "Owed outputs": OWES_SETTINGS,
    "Notice of a failure": NOTICE_SETTINGS,
    "Recorder": RECORD_SETTINGS,
    "Sandbox and secrets": (*CREDENTIAL_SETTINGS, *SANDBOX_SETTINGS),
    "Hot reload": RELOAD_SETTINGS,
    "Machines": MACHINE_SETTINGS,
}
NODES = nodes_setting(setting for section in _SECTIONS.values() for setting in section)
SECTIONS = {**_SECTIONS, "Nodes": (*_SECTIONS["Nodes"], NODES)}
"""All settings by concern, as --help shows them."""

SETTINGS = tuple(setting for section in SECTIONS.values() for setting in section)
