"""What people have to know about a dataflow that they have started: nodes by hand, a build."""

from collections.abc import Iterator

from dora_systemd.decisions.cell.launch import LaunchPlan
from dora_systemd.decisions.descriptor.build_session import session_path
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.descriptor.nodes import NodeKind
from dora_systemd.decisions.settings.sandbox import NETWORK
from dora_systemd.scope import Scope
from dora_systemd.values import shown
from dora_systemd.verbs.start.places import Look


def plan_notes(scope: Scope, dataflow: Dataflow, launch: LaunchPlan, look: Look) -> Iterator[str]:
    """A line for each thing to know or to do."""
    dynamic = [node.id for node in dataflow.nodes if node.kind is NodeKind.DYNAMIC]
    # No other process can reach the ports of a private network.
    if dynamic and look.settings[NETWORK] != "private":
        nodes = f"node{'s' if len(dynamic) > 1 else ''} {', '.join(dynamic)}"
        variables = f'eval "$(doractl {scope.flag} env {launch.options.name})"'
        yield f"start the dynamic {nodes} in another terminal, after: {variables}"
    path, uv = shown(dataflow.source), "--uv " if launch.options.uv else ""
    if not any(one.build or one.git for one in dataflow.nodes):
        return
    # `dora run` always builds first.
    if not launch.session.directories:
        yield f"no build of {path} is found; to build it: dora build {uv}{path}"
    elif _is_build_old(dataflow, look):
        yield f"{path} is newer than its last build; to build again: dora build {uv}{path}"


def _is_build_old(dataflow: Dataflow, look: Look) -> bool:
    """Whether the dataflow has changed since `dora build`."""
    session = str(session_path(dataflow.source))
    return look.sight.modified_ns(dataflow.source) > look.sight.modified_ns(session)
