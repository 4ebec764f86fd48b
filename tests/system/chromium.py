"""A real browser without a window, driven over its own protocol.

https://chromedevtools.github.io/devtools-protocol
"""

import base64
import json
import os
import signal
import subprocess
import tempfile
import urllib.request
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from websockets.sync.client import connect

from tests.lab.pace import bound
from tests.system.cells import wait_for

COMMAND = (
    *("chromium-headless-shell", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
    *("--remote-debugging-port=0", "--hide-scrollbars", "--force-color-profile=srgb"),
)
FAILURES = ("Runtime.exceptionThrown", "Log.entryAdded")
PICTURES = Path("/out")
"""The directory of LAB_OUT; without it no pictures are kept."""


class Browser:
    """Chromium with one page."""

    def __init__(self) -> None:
        # Its helpers may write for a moment longer than it lives.
        self._home = tempfile.TemporaryDirectory(prefix="chromium-", ignore_cleanup_errors=True)
        command = [*COMMAND, f"--user-data-dir={self._home.name}", "about:blank"]
        self._process = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)
        told = Path(self._home.name, "DevToolsActivePort")
        port = wait_for("Chromium", lambda: told.read_text().split() if told.exists() else [])[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
            pages = [one for one in json.load(answer) if one["type"] == "page"]
        self._link = connect(pages[0]["webSocketDebuggerUrl"], max_size=None, ping_interval=None)
        self._count = 0
        self._events: list[dict[str, Any]] = []
        for part in ("Runtime", "Page", "Network", "Log"):
            self.call(f"{part}.enable")

    def __enter__(self) -> "Browser":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._link.close()
        self._end()
        self._home.cleanup()

    def _end(self) -> None:
        """End all of it: the command is a shell script, and its page would keep the gateway up."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGTERM)
        self._process.wait(bound(20))
        wait_for("the end of Chromium", lambda: not self._has_processes())

    def _has_processes(self) -> bool:
        try:
            os.killpg(self._process.pid, 0)
        except ProcessLookupError:
            return False
        return True

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """A command of the protocol, and its result."""
        self._count += 1
        self._link.send(json.dumps({"id": self._count, "method": method, "params": params}))
        while True:
            message = json.loads(self._link.recv(timeout=bound(60)))
            if message.get("id") == self._count:
                assert "error" not in message, (method, message["error"])
                result: dict[str, Any] = message["result"]
                return result
            self._events.append(message)

    def js(self, expression: str) -> Any:
        """The value of an expression in the page; a promise is waited for."""
        done = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in done, (expression, done["exceptionDetails"])
        return done["result"].get("value")

    def wait_js(self, expression: str, seconds: float = 30.0) -> Any:
        """Its value as soon as that is true; what it looks at may be missing until then."""
        script = f"(() => {{try {{return {expression}}} catch {{return null}}}})()"
        return wait_for(expression, lambda: self.js(script), seconds)

    def text(self, selector: str) -> str:
        """What people read in an element, "" where there is none."""
        return str(self.js(f"document.querySelector({json.dumps(selector)})?.innerText ?? ''"))

    def wait_text(self, selector: str, part: str, seconds: float = 30.0) -> None:
        """Return when an element says that."""
        found = f"document.querySelector({json.dumps(selector)})?.innerText"
        self.wait_js(f"{found}?.includes({json.dumps(part)})", seconds)

    def click(self, selector: str) -> None:
        """A click with the mouse on an element, aimed again where the page moved it meanwhile."""
        self.wait_js(f"document.querySelector({json.dumps(selector)}) !== null")
        wait_for(f"a click on {selector}", lambda: self._has_hit(selector))

    def _has_hit(self, selector: str) -> bool:
        """Click in the middle of an element; whether that element got the click."""
        script = (
            f"(() => {{const e = document.querySelector({json.dumps(selector)});"
            "window.hit = false; window.addEventListener('click', ({ target }) =>"
            f" {{ window.hit = target.closest({json.dumps(selector)}) !== null }},"
            " { capture: true, once: true });"
            "e.scrollIntoView({block: 'center'}); const r = e.getBoundingClientRect();"
            "return [r.x + r.width / 2, r.y + r.height / 2]})()"
        )
        x, y = self.js(script)
        at = {"x": x, "y": y, "button": "left", "clickCount": 1}
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, **at)
        return bool(self.js("window.hit"))

    def point(self, selector: str, share: float) -> None:
        """The pointer over an element, at a share of its width."""
        place = f"document.querySelector({json.dumps(selector)})"
        self.js(f"{place}.scrollIntoView({{block: 'center'}})")
        box = self.js(f"{place}.getBoundingClientRect().toJSON()")
        at = {"x": box["x"] + share * box["width"], "y": box["y"] + box["height"] / 2}
        self.call("Input.dispatchMouseEvent", type="mouseMoved", **at)

    def fill(self, selector: str, value: str) -> None:
        """Type a value into a field, or choose it, and go on."""
        place = f"document.querySelector({json.dumps(selector)})"
        self.js(f"{place}.value = {json.dumps(value)}")
        self.js(f"{place}.dispatchEvent(new Event('change')), 0")

    def press(self, key: str, text: str = "") -> None:
        """A key, as KeyboardEvent.key names it."""
        codes = {"Enter": 13, "Tab": 9, "Escape": 27, " ": 32, "ArrowLeft": 37, "End": 35}
        more = {"windowsVirtualKeyCode": codes[key], **({"text": text} if text else {})}
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, **more)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key, **more)

    def open(self, url: str, width: int = 1280, height: int = 900) -> None:
        """Go there, in a window of that size."""
        self.resize(width, height)
        self.call("Page.navigate", url=url)

    def resize(self, width: int, height: int, is_phone: bool = False) -> None:
        """Another size of the window."""
        size = {"width": width, "height": height, "deviceScaleFactor": 2 if is_phone else 1}
        self.call("Emulation.setDeviceMetricsOverride", **size, mobile=is_phone)

    def prefer(self, scheme: str) -> None:
        """What the reader has chosen: light or dark."""
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.call("Emulation.setEmulatedMedia", features=features)

    def picture(self, name: str, is_whole: bool = False) -> None:
        """A picture of the page, or of all of it, for people, where LAB_OUT says."""
        if PICTURES.is_dir():
            taken = self.call(
                "Page.captureScreenshot", format="png", captureBeyondViewport=is_whole
            )
            (PICTURES / f"{name}.png").write_bytes(base64.b64decode(taken["data"]))

    def requests(self) -> list[str]:
        """The addresses that were asked for so far."""
        sent = [one for one in self._events if one["method"] == "Network.requestWillBeSent"]
        return [one["params"]["request"]["url"] for one in sent]

    def failures(self) -> list[dict[str, Any]]:
        """Errors in scripts, and what the Content-Security-Policy has stopped."""
        self.js("0")
        return [one["params"] for one in self._events if one["method"] in FAILURES]
