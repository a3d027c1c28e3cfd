"""Headless Chromium for tests, by the DevTools protocol over a pipe: nothing but the browser itself is needed."""

from __future__ import annotations

import base64
import itertools
import json
import os
import shutil
import subprocess
import threading
import time
from pathlib import Path

FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --disable-dev-shm-usage --hide-scrollbars --remote-debugging-pipe"
).split()
PATIENCE = 60  # seconds for an answer; CI machines are slow


def find_chromium() -> str | None:
    """Path of a Chromium, if there is one."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    return os.environ.get("CHROMIUM") or next((p for p in map(shutil.which, names) if p), None)


class Browser:
    """One Chromium with one page, 1280 x 800.

    Attributes:
        errors: what the page threw or logged as an error.
    """

    def __init__(self, profile: Path):
        self.errors: list[str] = []
        self._ids = itertools.count(1)
        self._answers: dict[int, dict] = {}
        self._news = threading.Condition()
        read, self._write = os.pipe()
        self._read, write = os.pipe()
        self._process = subprocess.Popen(
            [find_chromium(), *FLAGS, f"--user-data-dir={profile}", "about:blank"],
            preexec_fn=lambda: _place(read, write),  # the browser reads from 3 and writes to 4
            close_fds=False,  # which would close them; Python's own do not pass to a child
            stderr=subprocess.DEVNULL,
        )
        os.close(read)
        os.close(write)
        threading.Thread(target=self._listen, daemon=True).start()
        targets = self._send("Target.getTargets")["targetInfos"]
        page = next(t["targetId"] for t in targets if t["type"] == "page")
        self._session = self._send("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        self.resize(1280, 800)

    def _listen(self) -> None:
        with open(self._read, "rb", closefd=True) as stream:
            rest = b""
            while piece := stream.read1(1 << 16):
                *messages, rest = (rest + piece).split(b"\0")
                for m in map(json.loads, messages):
                    self._hear(m)

    def _hear(self, m: dict) -> None:
        with self._news:
            if "id" in m:
                self._answers[m["id"]] = m
            elif m["method"] == "Runtime.exceptionThrown":
                details = m["params"]["exceptionDetails"]
                self.errors.append(details.get("exception", {}).get("description") or details["text"])
            elif m["method"] == "Runtime.consoleAPICalled" and m["params"]["type"] == "error":
                self.errors.append(str([a.get("value", a.get("description")) for a in m["params"]["args"]]))
            self._news.notify_all()

    def _send(self, method: str, session: str | None = None, **params) -> dict:
        n = next(self._ids)
        message = {"id": n, "method": method, "params": params} | ({"sessionId": session} if session else {})
        os.write(self._write, json.dumps(message).encode() + b"\0")
        with self._news:
            if not self._news.wait_for(lambda: n in self._answers, PATIENCE):
                raise TimeoutError(f"{method}: no answer from the browser")
            answer = self._answers.pop(n)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        return answer["result"]

    def call(self, method: str, **params) -> dict:
        """A command of the DevTools protocol, for the page."""
        return self._send(method, self._session, **params)

    def resize(self, width: int, height: int, *, mobile: bool = False, scale: float = 1) -> None:
        """Sets the size of the window."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=mobile
        )
        self.call("Emulation.setTouchEmulationEnabled", enabled=mobile)

    def goto(self, url: str) -> None:
        """Opens a page; `errors` starts anew."""
        self.errors.clear()
        self.call("Page.navigate", url=url)
        self.wait("document.readyState === 'complete'")

    def eval(self, script: str):
        """Value of a JavaScript expression; promises are waited for.

        Raises:
            RuntimeError: it threw.
        """
        result = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in result:
            details = result["exceptionDetails"]
            raise RuntimeError(details.get("exception", {}).get("description") or details["text"])
        return result["result"].get("value")

    def wait(self, script: str, seconds: float = 60):
        """The value of an expression as soon as it is true.

        Raises:
            TimeoutError: it does not become true.
        """
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if value := self.eval(script):
                return value
            time.sleep(0.05)
        raise TimeoutError(f"not true within {seconds} s: {script}; errors of the page: {self.errors}")

    def key(self, key: str) -> None:
        """Presses a key, e.g. " " or "ArrowRight"."""
        text = {"text": key} if len(key) == 1 else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key)

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: str = "left") -> None:
        """Drags the mouse."""
        held = {"left": 1, "right": 2}[button]
        for kind, (x, y) in (("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=held, clickCount=1)

    def wheel(self, x: float, y: float, delta: float) -> None:
        """Turns the mouse wheel; positive: towards the viewer."""
        self.call("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=delta)

    def screenshot(self, path: Path) -> None:
        """Writes the window as a PNG."""
        Path(path).write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))

    def close(self) -> None:
        """Ends the browser."""
        try:
            self._send("Browser.close")
        except (OSError, TimeoutError, RuntimeError):
            pass
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
        os.close(self._write)


def _place(read: int, write: int) -> None:
    """Moves two descriptors to 3 and 4, by way of high ones, since they may be 4 and 3."""
    high = (os.dup2(read, 250, inheritable=False), os.dup2(write, 251, inheritable=False))
    for source, target in zip(high, (3, 4), strict=True):
        os.dup2(source, target)
