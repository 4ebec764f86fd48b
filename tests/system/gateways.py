"""The gateway of one user or of the system, as the system tests see it."""

import subprocess
import time
from pathlib import Path
from typing import NamedTuple

from dora_systemd.decisions.gateway.place import DEFAULT_PORT, SERVICE_UNIT, SOCKET_UNIT, token_path
from dora_systemd.scope import Scope
from tests.system.cells import journalctl, run, wait_for


class Reply(NamedTuple):
    """An HTTP response; status 0 where there was none."""

    status: int
    body: str


class Front:
    """The gateway of the system, or that of a user who has a manager of his own."""

    def __init__(self, user: str = "root", uid: int = 0, port: int = DEFAULT_PORT) -> None:
        self.user = user
        self.scope = Scope(is_user=uid != 0, uid=uid)
        self.port = port
        self.begun = time.time()

    def command(self, *words: str) -> list[str]:
        """A command of this user."""
        runtime = f"XDG_RUNTIME_DIR=/run/user/{self.scope.uid}"
        switch = ["runuser", "-u", self.user, "--", "env", runtime] if self.scope.is_user else []
        return [*switch, *words]

    def doractl(self, *words: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        """Run doractl as this user."""
        return run(*self.command("doractl", self.scope.flag, *words), check=check)

    def systemctl(self, *words: str, check: bool = True) -> str:
        """The output of systemctl."""
        return run(*self.command("systemctl", self.scope.flag, *words), check=check).stdout

    def show(self, name: str, unit: str = SERVICE_UNIT) -> str:
        """A property as `systemctl show` prints it."""
        return self.systemctl("show", "--value", "--property", name, unit).strip()

    def up(self) -> str:
        """`doractl up`, and what it prints."""
        return self.doractl("up", "--port", str(self.port)).stdout

    @property
    def pid(self) -> int:
        """The gateway's process, 0 while it rests."""
        return int(self.show("MainPID"))

    @property
    def token(self) -> str:
        """What callers of other users need."""
        return token_path(self.scope).read_text().strip()

    def get(self, path: str, *options: str, user: str = "") -> Reply:
        """GET by curl, as `user`."""
        switch = ["runuser", "-u", user, "--"] if user else []
        url = f"http://127.0.0.1:{self.port}{path}"
        curl = ["curl", "-s", "--max-time", "30", "-w", "\n%{http_code}", *options, url]
        body, _, status = run(*switch, *curl, check=False).stdout.rpartition("\n")
        return Reply(int(status), body)

    def rest_after(self, duration: str) -> None:
        """Have the gateway end after so long without a connection."""
        drop_in = self.scope.runtime_root / "systemd"
        drop_in /= f"{'user' if self.scope.is_user else 'system'}/{SERVICE_UNIT}.d/90-test.conf"
        start = self.show("ExecStart").partition("argv[]=")[2].partition(" ;")[0]
        command = start.rpartition("=")[0]
        text = f"[Service]\nExecStart=\nExecStart={command}={duration}\n"
        drop_in.parent.mkdir(exist_ok=True)
        drop_in.write_text(text)
        self.systemctl("daemon-reload")
        self.systemctl("stop", SERVICE_UNIT)

    def journal(self) -> str:
        """What the gateway has written in this test."""
        which = "--user-unit" if self.scope.is_user else "--unit"
        since = f"--since=@{self.begun:.6f}"
        return journalctl("-o", "cat", since, which, SERVICE_UNIT)

    def wait_resting(self) -> None:
        """Return when the gateway has ended."""
        wait_for("the gateway rests", lambda: self.show("ActiveState") == "inactive")

    def end(self) -> None:
        """Leave nothing of it."""
        self.systemctl("stop", SOCKET_UNIT, check=False)
        self.systemctl("reset-failed", SOCKET_UNIT, SERVICE_UNIT, check=False)
        place = self.scope.runtime_root / "systemd" / ("user" if self.scope.is_user else "system")
        for path in sorted(place.glob("dora-gateway*/*")) + sorted(place.glob("dora-gateway*")):
            path.rmdir() if path.is_dir() else path.unlink()
        self.systemctl("daemon-reload")
        assert not Path(token_path(self.scope)).parent.exists()
