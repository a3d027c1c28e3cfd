"""Shared by the tests of the player: a stream, servers with faults, and queries to a page."""

import base64
import http.client
import http.server
import json
import socket
import threading
import time

import cv2
import numpy as np
from synthetic import blob, moved

from gscodec.model.camera import Camera, look_at
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.player.server import parse_range

FPS, GROUPS, LENGTH = 30, 5, 6


def sequence(n=400, sh_count=0) -> GaussianSequence:
    """A turning blob in groups; every second group has lifetimes."""
    still, groups = blob(n, sh_count=sh_count), []
    for k in range(GROUPS):
        frames = [moved(still, [0, 0.05 * t, 0], [0.01 * t, 0, 0]) for t in range(k * LENGTH, (k + 1) * LENGTH)]
        life = np.tile(np.array([0, LENGTH], np.int32), (n, 1))
        life[: n // 4, 1] = LENGTH // 2
        groups.append(DenseGroup(frames, life if k % 2 else None))
    return GaussianSequence(FPS, groups)


def cameras() -> list[Camera]:
    """Two reference cameras with off-centre axes."""
    K = np.array([[300.0, 0, 130], [0, 290, 90], [0, 0, 1]])
    eyes = ([3.0, 0.5, -2], [-2.5, 1, 2.5])
    return [
        Camera(f"cam{i}", K, look_at(np.array(e), np.zeros(3), np.array([0, 1.0, 0])), 256, 192)
        for i, e in enumerate(eyes)
    ]


def serving(server: http.server.HTTPServer):
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server


def ask(server, path="/stream.gsv", method="GET", **headers):
    """(status, headers, body) of a request."""
    c = http.client.HTTPConnection(*server.server_address[:2], timeout=10)
    c.request(method, path, headers={k.replace("_", "-"): v for k, v in headers.items()})
    r = c.getresponse()
    body = r.read()
    c.close()
    return r.status, dict(r.getheaders()), body


class Trouble(http.server.BaseHTTPRequestHandler):
    """A plain server with Range and CORS; its attributes set faults."""

    protocol_version = "HTTP/1.1"
    data = b""
    log: list
    drop_after: int | None = None  # bytes of a body after which the connection is cut
    fail_first = 0
    refused = False
    ranges = True
    kind = "video/mp4"
    rate: int | None = None  # bytes a second

    def do_HEAD(self):
        self.send_response(200)
        self.send_header("Content-Length", str(len(self.data)))
        self.cors()

    def do_GET(self):
        value = self.headers.get("Range")
        self.log.append(value)
        cls = type(self)
        if cls.fail_first > 0:
            cls.fail_first -= 1
            self.send_error(503)
            return
        if cls.refused:
            self.send_response(403)
            self.send_header("Content-Length", "0")
            self.cors()
            return
        size = len(self.data)
        try:
            found = parse_range(value, size) if self.ranges else None
        except ValueError:
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{size}")
            self.send_header("Content-Length", "0")
            self.cors()
            return
        start, end = found or (0, size)
        self.send_response(206 if found else 200)
        if found:
            self.send_header("Content-Range", f"bytes {start}-{end - 1}/{size}")
        self.send_header("Content-Length", str(end - start))
        self.cors()
        if self.drop_after is not None and end - start > self.drop_after:
            self.wfile.write(self.data[start : start + self.drop_after])
            self.wfile.flush()
            time.sleep(0.2)  # the sent bytes arrive before the end of the connection
            self.connection.shutdown(socket.SHUT_RDWR)
            self.close_connection = True
            return
        for at in range(start, end, 2000):
            self.wfile.write(self.data[at : min(at + 2000, end)])
            if self.rate:
                time.sleep(2000 / self.rate)

    def cors(self):
        self.send_header("Content-Type", self.kind)
        self.send_header("Access-Control-Allow-Origin", "*")
        self.end_headers()

    def log_message(self, *args):
        pass


class Static(http.server.SimpleHTTPRequestHandler):
    """A static host with CORS that ignores ranges."""

    def end_headers(self):
        self.send_header("Access-Control-Allow-Origin", "*")
        super().end_headers()

    def log_message(self, *args):
        pass


PLAYER = "document.querySelector('gsv-player')"


def part(selector: str) -> str:
    return f"{PLAYER}.shadowRoot.querySelector({json.dumps(selector)})"


def load(browser, url, **options) -> None:
    """Opens the page and waits for the first picture."""
    query = "&".join(f"{k}={v}" for k, v in options.items())
    browser.goto(f"{url}?{query}" if query else url)
    browser.wait(f"{PLAYER}.camera && {PLAYER}.stats.gaussians > 0")


def pixels(browser, canvas: str) -> np.ndarray:
    """[H, W, 3] u8: pixels of the canvas that a JavaScript expression or its promise returns.

    The canvas is read in the task that draws it, since a WebGL canvas may be empty afterwards.
    """
    script = f"""Promise.resolve({canvas}).then((from) => {{
        const copy = Object.assign(document.createElement("canvas"), {{ width: from.width, height: from.height }});
        const context = copy.getContext("2d");
        context.drawImage(from, 0, 0);
        const d = context.getImageData(0, 0, copy.width, copy.height).data;
        let s = ""; for (let i = 0; i < d.length; i += 8192) s += String.fromCharCode(...d.subarray(i, i + 8192));
        return [copy.width, copy.height, btoa(s)];
    }})"""
    w, h, data = browser.eval(script)
    return np.frombuffer(base64.b64decode(data), np.uint8).reshape(h, w, 4)[..., :3]


def canvas(browser) -> np.ndarray:
    """[H, W, 3] u8: the picture drawn by the CPU."""
    return pixels(browser, part("canvas"))


def screenshot(browser, element: str) -> np.ndarray:
    """[H, W, 3] u8: the screen at the place of an element."""
    box = browser.eval(
        f"(({{ x, y, width, height }}) => ({{ x, y, width, height }}))({element}.getBoundingClientRect())"
    )
    png = np.frombuffer(browser.screenshot(box), np.uint8)
    return cv2.imdecode(png, cv2.IMREAD_COLOR)[..., ::-1]


def camera_of(view: list[float]) -> Camera:
    w, h, fx, fy, cx, cy, *m, near, low_pass = view
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return Camera("view", K, np.array([*m, 0, 0, 0, 1.0]).reshape(4, 4), int(w), int(h), near=near, low_pass=low_pass)


def show(browser, t: int) -> Camera:
    """Stops at frame `t`; returns the camera of the view."""
    return camera_of(browser.eval(f"{PLAYER}.show({t}).then((d) => Array.from(d.view))"))


def psnr(a, b) -> float:
    return 10 * np.log10(255**2 / max(np.mean((a.astype(float) - b) ** 2), 1e-9))


def notes(browser) -> str:
    return browser.eval(f"{part('.notes')}.innerText")


def error_text(browser) -> str:
    return browser.wait(f"!{part('.error')}.hidden && {part('.error')}.innerText")
