"""A headless Chromium for tests of pages, by the DevTools protocol over a pipe; nothing but the standard library."""

import base64
import fcntl
import json
import os
import pathlib
import select
import shutil
import subprocess
import sys
from typing import Any

PROGRAM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_SECONDS = 60.0
_KEYS = {"ArrowLeft": 37, "ArrowRight": 39, "Home": 36, "End": 35, " ": 32, "Enter": 13}
# Chromium reads commands from descriptor 3 and writes answers to 4.
_LAUNCH = "import os, sys; os.dup2({0}, 3); os.dup2({1}, 4); os.execv(sys.argv[1], sys.argv[1:])"


class Chromium:
    """One tab. `complaints` are the errors of its scripts, `requests` all that it asked for."""

    def __init__(self, profile: pathlib.Path) -> None:
        """Args: profile: an empty folder."""
        assert PROGRAM is not None
        commands, self._write = os.pipe()
        self._read, answers = os.pipe()
        theirs = [fcntl.fcntl(descriptor, fcntl.F_DUPFD, 10) for descriptor in (commands, answers)]
        self._process = subprocess.Popen(
            [sys.executable, "-c", _LAUNCH.format(*theirs), PROGRAM, "--headless", "--disable-gpu", "--hide-scrollbars",
             "--no-sandbox", "--remote-debugging-pipe", f"--user-data-dir={profile}"],  # containers have no sandbox
            pass_fds=theirs, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for descriptor in (commands, answers, *theirs):
            os.close(descriptor)
        self._number, self._received, self._session = 0, b"", None
        self.complaints: list[str] = []
        self.requests: list[str] = []
        tab = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=tab, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def close(self) -> None:
        """End the browser."""
        self._session = None
        self.call("Browser.close")
        self._process.wait(_SECONDS)
        os.close(self._write)
        os.close(self._read)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """A command of the protocol, and its result."""
        self._number += 1
        session = {} if self._session is None else {"sessionId": self._session}
        message = {"id": self._number, "method": method, "params": parameters, **session}
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self._number:
            self._note(answer)
        assert "error" not in answer, answer
        return answer["result"]

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._received:
            assert select.select([self._read], [], [], _SECONDS)[0], "Chromium does not answer"
            part = os.read(self._read, 1 << 16)
            assert part, "Chromium has ended"
            self._received += part
        one, _, self._received = self._received.partition(b"\0")
        return json.loads(one)

    def _note(self, event: dict[str, Any]) -> None:
        method, told = event.get("method"), event.get("params", {})
        if method == "Network.requestWillBeSent":
            self.requests.append(told["request"]["url"])
        elif method == "Runtime.exceptionThrown" or (
                method == "Log.entryAdded" and told["entry"]["level"] == "error"):
            self.complaints.append(json.dumps(told))

    def evaluate(self, script: str) -> Any:
        """The value of an expression in the page; a promise is waited for."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def open(self, path: pathlib.Path) -> None:
        """Show a file, and wait until it has been drawn."""
        self.call("Page.navigate", url=path.as_uri())
        self.settle()

    def settle(self) -> None:
        """Wait until what was asked for has been drawn."""
        self.evaluate("new Promise((done) => { const drawn = () => requestAnimationFrame(() => requestAnimationFrame("
                      "() => setTimeout(done, 50))); document.readyState === 'complete' ? drawn() "
                      ": addEventListener('load', drawn); })")

    def resize(self, width: int, height: int, dark: bool = False) -> None:
        """The window's size in pixels, and whether dark pages are preferred."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1,
                  mobile=width < 600)
        self.call("Emulation.setEmulatedMedia",
                  features=[{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}])
        self.settle()

    def press(self, key: str) -> None:
        """Press and release a key by its DOM name."""
        common = {"key": key, "code": "Space" if key == " " else key, "windowsVirtualKeyCode": _KEYS[key]}
        text = {"text": key} if key == " " else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", **common, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", **common)

    def point(self, selector: str, across: float, down: float, click: bool = False) -> None:
        """Move the mouse over an element, to fractions of its width and height, and click there."""
        left, top, width, height = self.evaluate(
            f"(() => {{ const element = document.querySelector({selector!r}); element.scrollIntoView("
            "{block: 'center'}); const box = element.getBoundingClientRect();"
            "return [box.left, box.top, box.width, box.height]; })()")
        place = {"x": left + across * width, "y": top + down * height}
        self.call("Input.dispatchMouseEvent", type="mouseMoved", **place)
        if click:
            for kind in ("mousePressed", "mouseReleased"):
                self.call("Input.dispatchMouseEvent", type=kind, button="left", buttons=1, clickCount=1, **place)

    def text(self, selector: str) -> str:
        """What an element says."""
        return self.evaluate(f"document.querySelector({selector!r}).textContent")

    def screenshot(self, path: pathlib.Path) -> None:
        """What the window shows, as a PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))
