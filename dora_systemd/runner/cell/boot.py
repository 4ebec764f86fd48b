"""The dora of the first run boots in a thread, while the rest of the runner is imported."""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.dora import engine
from dora_systemd.adapters.host.process import beside
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.begin import Daemon, daemon_variables, start_daemon

LISTEN_SECONDS = 1.0
"""Time for the coordinator to listen. If it takes longer, the daemon is started after the imports,
and the checks need not wait for a coordinator that hangs."""


class EarlyDaemon:
    """Enables the controllers for the nodes, and starts the daemon once the coordinator listens.

    unit: cgroup directory. environment: of the nodes. token, more: as of start_daemon().
    """

    def __init__(
        self,
        options: RunnerOptions,
        paths: CellPaths,
        unit: Path,
        environment: Mapping[str, str],
        token: str = "",
        more: Sequence[str] = (),
    ) -> None:
        self._dora, self._paths, self._unit = options.dora, paths, unit
        self._environment = {**environment, **daemon_variables(options, paths, unit, environment)}
        self._port, self._token, self._more = 0, token, more
        self._work = beside(self._start_daemon)

    def _start_daemon(self) -> Daemon | None:
        # The kernel makes this wait for some 10 ms. Nodes does it too, and reports errors.
        with contextlib.suppress(OSError):
            cgroup.enable_controllers(self._unit)
        self._port = self._find_port()
        with contextlib.suppress(OSError):  # Engine tries again, and reports it
            if self._port:
                return self._spawn_daemon()
        return None

    def _find_port(self) -> int:
        """Return the port of the coordinator; 0 if it does not listen, or not yet."""
        raise NotImplementedError

    def _spawn_daemon(self) -> Daemon:
        given = (self._dora, self._paths, self._port, self._environment)
        return start_daemon(*given, self._token, self._more)

    def daemon(self) -> Daemon | None:
        """Wait for the daemon to be started; None if it is not, or not yet."""
        return self._work.result()


class Boot(EarlyDaemon):
    """EarlyDaemon of a machine that runs the coordinator, which is started already."""

    def __init__(
        self,
        coordinator: engine.Child,
        options: RunnerOptions,
        paths: CellPaths,
        unit: Path,
        environment: Mapping[str, str],
        more: Sequence[str] = (),
    ) -> None:
        self.coordinator = coordinator
        super().__init__(options, paths, unit, environment, more=more)

    def _find_port(self) -> int:
        return engine.read_port(self.coordinator, LISTEN_SECONDS)

    def listens(self) -> bool:
        """Wait for the coordinator; False if it does not listen, or not yet."""
        self._work.result()
        return self._port > 0
