"""The scripts of docs/on-failure.md, as they are there, against servers on this machine."""

import json
import os
import re
import socket
import socketserver
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from tests.system.cells import Cell, Project, wait_for
from tests.system.test_on_failure import FAILS, FLOW, SINK, SOURCE
from tests.system.typed import Shell, by_kind, replay

# The units of notices are installed below /usr/local.
pytestmark = [pytest.mark.lab, pytest.mark.usefixtures("units_for_all")]

PAGE = Path(__file__).parents[2] / "docs/on-failure.md"
SCRIPTS = {
    found[2]: found[1]
    for found in re.finditer(r"^```\w+\n(#!/\S+\n# (\S+)\n.*?)^```$", PAGE.read_text(), re.M | re.S)
}
SENDMAIL = """#!/bin/sh
exec curl --silent --url "smtp://$SMTP" --mail-from robot@lab --mail-rcpt "$MAIL_TO" -T -
"""


class Requests(HTTPServer):
    """A web server that keeps what it gets."""

    def __init__(self) -> None:
        self.got: list[tuple[dict[str, str], str]] = []
        super().__init__(("127.0.0.1", 0), Handler)


class Handler(BaseHTTPRequestHandler):
    """Keeps the header fields and the body of a request."""

    server: Requests

    def do_POST(self) -> None:
        """Take a message."""
        body = self.rfile.read(int(self.headers["Content-Length"])).decode()
        self.server.got.append((dict(self.headers), body))
        self.send_response(200)
        self.end_headers()

    def log_message(self, *words: object) -> None:
        """Print nothing."""


class Mails(socketserver.TCPServer):
    """A mail server that keeps what it gets."""

    allow_reuse_address = True

    def __init__(self) -> None:
        self.got: list[str] = []
        super().__init__(("127.0.0.1", 0), MailHandler)


class MailHandler(socketserver.StreamRequestHandler):
    """Enough of SMTP for one mail."""

    server: Mails

    def handle(self) -> None:
        """Take a mail."""
        self.wfile.write(b"220 lab\r\n")
        for line in self.rfile:
            if line.startswith(b"DATA"):
                self.wfile.write(b"354 go\r\n")
                self.server.got.append("".join(self.mail()))
            self.wfile.write(b"250 ok\r\n")
            if line.startswith(b"QUIT"):
                return

    def mail(self) -> Iterator[str]:
        """The lines of a mail."""
        while (line := self.rfile.readline()) not in (b".\r\n", b""):
            yield line.decode()


@pytest.fixture
def named(project: Project) -> Iterator[Cell]:
    """The dataflow of the page."""
    del project  # it outlives the dataflow
    cell = Cell("night")
    yield cell
    cell.end()


@pytest.fixture
def web() -> Iterator[Requests]:
    with Requests() as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture
def mails() -> Iterator[Mails]:
    with Mails() as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


def port_of(server: socketserver.TCPServer) -> int:
    address: tuple[str, int] = socket.socket.getsockname(server.socket)
    return address[1]


def fail(cell: Cell, project: Project, script: str, **env: str) -> None:
    """A node is given up, in a dataflow with that script and these variables."""
    project.write("source.py", SOURCE)
    project.write("sink.py", SINK)
    project.write(script, SCRIPTS[script]).chmod(0o755)
    (project.root / "lamp").mkdir()
    (project.root / "lamp").chmod(0o777)
    settings = {"on_failure": [f"./{script}"], "env": env, "writable": [f"{project.root}/lamp"]}
    project.write("flow.systemd.yml", json.dumps(settings))
    cell.start(project.write("flow.yml", FLOW))
    project.write("crash", "")


def test_the_page_has_five_scripts() -> None:
    assert [*SCRIPTS] == ["mail.sh", "ntfy.sh", "webhook.sh", "chat.py", "lamp.sh"]


@pytest.mark.warns(*FAILS)
def test_mail(cell: Cell, project: Project, mails: Mails) -> None:
    sendmail = project.write("sendmail", SENDMAIL)
    sendmail.chmod(0o755)
    smtp = f"127.0.0.1:{port_of(mails)}"
    fail(cell, project, "mail.sh", MAIL_TO="op@lab", SENDMAIL=str(sendmail), SMTP=smtp)
    (mail,) = wait_for("the mail", lambda: mails.got)
    head, _, body = mail.replace("\r", "").partition("\n\n")
    assert head.startswith(f"To: op@lab\nSubject: {cell.name} on ")
    assert f"\n{cell.name}: Degraded\n" in body


@pytest.mark.warns(*FAILS)
def test_ntfy(cell: Cell, project: Project, web: Requests) -> None:
    fail(cell, project, "ntfy.sh", NTFY_URL=f"http://127.0.0.1:{port_of(web)}/robots")
    ((fields, body),) = wait_for("the request", lambda: web.got)
    assert fields["Title"].startswith(f"{cell.name} on ")
    assert "source stays down" in body


NIGHT = """
nodes:
  - {id: camera, path: camera.py, inputs: {tick: dora/timer/millis/20}}
  - {id: driver, path: driver.py, inputs: {tick: dora/timer/millis/20}}
  - {id: arm, path: sink.py, inputs: {tick: dora/timer/secs/1}}
"""


def night() -> tuple[str, str, str]:
    """The settings, what the telephone shows, and what is typed in the morning."""
    text = PAGE.read_text().partition("## A night\n")[2].partition("\n## ")[0]
    settings, titles, typed = re.findall(r"^```\w*\n(.*?)^```$", text, re.M | re.S)
    host = os.uname().nodename
    return settings, titles.replace("arm-3", host), typed.replace("arm-3", host)


def test_a_night(named: Cell, project: Project, web: Requests) -> None:
    """The story of the page, with the settings that are there."""
    settings, titles, typed = night()
    for node, status in (("camera", 7), ("driver", 3)):
        text = SOURCE.replace('"crash"', f'"{node}.broken"').replace("exit(7)", f"exit({status})")
        project.write(f"{node}.py", text)
    project.write("sink.py", SINK)
    project.write("ntfy.sh", SCRIPTS["ntfy.sh"]).chmod(0o755)
    url = f"http://127.0.0.1:{port_of(web)}/robots"
    project.write("night.systemd.yml", f"{settings}env: {{NTFY_URL: '{url}'}}\n")
    named.start(project.write("night.yml", NIGHT))
    project.write("camera.broken", "")
    wait_for("the first message", lambda: web.got)
    project.write("driver.broken", "")
    wait_for("some restarts", lambda: int(named.show("NRestarts")) >= 3)
    for node in ("camera", "driver"):
        (project.root / f"{node}.broken").unlink()
    wait_for("the second message", lambda: len(web.got) > 1, 60)
    shown = "".join(f"{fields['Title']}\n" for fields, _ in web.got[:2])
    assert by_kind(shown) == by_kind(titles)
    shell = Shell(["env", "SYSTEMD_PAGER=cat"], project.root)
    wrong = replay(shell, typed)
    shell.end()
    assert not wrong, "".join(wrong)


@pytest.mark.warns(*FAILS)
def test_webhook(cell: Cell, project: Project, web: Requests) -> None:
    fail(cell, project, "webhook.sh", WEBHOOK_URL=f"http://127.0.0.1:{port_of(web)}/")
    ((_, body),) = wait_for("the request", lambda: web.got)
    assert json.loads(body)["node"] == "source"


@pytest.mark.warns(*FAILS)
def test_chat(cell: Cell, project: Project, web: Requests) -> None:
    fail(cell, project, "chat.py", CHAT_URL=f"http://127.0.0.1:{port_of(web)}/hook")
    ((_, body),) = wait_for("the request", lambda: web.got)
    assert json.loads(body)["text"].startswith(f"{cell.name} on ")


@pytest.mark.warns(*FAILS)
def test_lamp(cell: Cell, project: Project) -> None:
    color = project.root / "lamp/color"
    fail(cell, project, "lamp.sh", LAMP=str(color.parent))
    wait_for("the lamp", color.exists)
    wait_for("its color", lambda: color.read_text() == "yellow\n")
