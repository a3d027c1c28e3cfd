"""Headless Chromium, the system's own, for the tests and measurements of the player; driven by Playwright."""

from __future__ import annotations

import base64
import os
import shutil

from playwright.sync_api import Error, sync_playwright

FLAGS = ("--no-sandbox", "--disable-dev-shm-usage")
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # WebGL2 without a GPU
PATIENCE = 60  # seconds for an answer; CI machines are slow


def find_chromium() -> str | None:
    """Path of a Chromium, if there is one."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    return os.environ.get("CHROMIUM") or next((p for p in map(shutil.which, names) if p), None)


class Browsers:
    """Starts Chromiums and closes all of them at the end.

    Raises:
        playwright.sync_api.Error: Chromium cannot be started.
    """

    def __enter__(self) -> Browsers:
        self._playwright = sync_playwright().start()
        self._started = []
        return self

    def __exit__(self, *_) -> None:
        for browser in self._started:
            browser.close()
        self._playwright.stop()

    def start(self, *flags: str) -> Browser:
        """A Chromium with one page."""
        launch = self._playwright.chromium.launch
        self._started.append(launch(executable_path=find_chromium(), args=[*FLAGS, *flags]))
        return Browser(self._started[-1])


class Browser:
    """One page, 1280 x 800.

    Attributes:
        errors: exceptions and logged errors of the page.
    """

    def __init__(self, chromium):
        self.errors: list[str] = []
        self.page = chromium.new_context(viewport={"width": 1280, "height": 800}).new_page()
        self.page.set_default_timeout(1000 * PATIENCE)
        self.page.on("pageerror", lambda e: self.errors.append(e.stack or str(e)))
        self.page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        self._devtools = self.page.context.new_cdp_session(self.page)

    def call(self, method: str, **params) -> dict:
        """Sends a command of the DevTools protocol for the page."""
        return self._devtools.send(method, params)

    def resize(self, width: int, height: int, *, mobile: bool = False, scale: float = 1) -> None:
        """Sets the size of the window; `mobile`: a phone's, with touch."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": mobile}
        self.call("Emulation.setDeviceMetricsOverride", **metrics)
        self.call("Emulation.setTouchEmulationEnabled", enabled=mobile)

    def goto(self, url: str) -> None:
        """Opens a page and empties `errors`."""
        self.errors.clear()
        self.page.goto(url)

    def eval(self, script: str):
        """Value of a JavaScript expression; a promise is awaited.

        Raises:
            playwright.sync_api.Error: the expression throws.
        """
        return self.page.evaluate(script)

    def wait(self, script: str, seconds: float = PATIENCE):
        """Waits until an expression is true; returns its value.

        Raises:
            TimeoutError: it is not true after `seconds`.
        """
        try:
            return self.page.wait_for_function(script, timeout=1000 * seconds, polling=50).json_value()
        except Error as e:
            raise TimeoutError(f"not true within {seconds} s: {script}; errors of the page: {self.errors}") from e

    def key(self, key: str) -> None:
        """Presses a key, e.g. " " or "ArrowRight"."""
        self.page.keyboard.press(key)

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: str = "left") -> None:
        """Drags the mouse."""
        mouse = self.page.mouse
        mouse.move(*start)
        mouse.down(button=button)
        mouse.move(*end)
        mouse.up(button=button)

    def fingers(self, *ways: list[tuple[float, float]]) -> None:
        """Touch: one list of positions per finger, all of the same length."""
        for i, places in enumerate(zip(*ways, strict=True)):
            points = [{"x": x, "y": y, "id": n} for n, (x, y) in enumerate(places)]
            self.call("Input.dispatchTouchEvent", type="touchMove" if i else "touchStart", touchPoints=points)
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def wheel(self, x: float, y: float, delta: float) -> None:
        """Turns the mouse wheel at (x, y); a negative `delta` zooms in."""
        self.page.mouse.move(x, y)
        self.page.mouse.wheel(0, delta)

    def screenshot(self, box: dict | None = None) -> bytes:
        """PNG of the window, or of its part `box` (x, y, width, height), at the size set by `resize`."""
        clip = {"clip": box | {"scale": 1}} if box else {}
        return base64.b64decode(self.call("Page.captureScreenshot", **clip)["data"])
