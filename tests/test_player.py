"""The web player: the server and its ranges, the built files, and the page in a real Chromium."""

import base64
import http.client
import http.server
import importlib.util
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from email.utils import formatdate
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, find_chromium
from synthetic import blob, moved

from gscodec.camera import Camera
from gscodec.decode import open_stream
from gscodec.encode.encode import EncodeSettings, encode_groups, stream_config
from gscodec.errors import UsageError
from gscodec.gaussians import GaussianSequence, Group
from gscodec.player.server import FILES, PAGE, Server, parse_range
from gscodec.render.image import render_image

ROOT = Path(__file__).parent.parent
FPS, GROUPS, LENGTH = 30, 5, 6


def sequence(n=400, sh_count=0) -> GaussianSequence:
    """A blob that turns, in groups; every second group has lifetimes."""
    still, groups = blob(n, sh_count=sh_count), []
    for k in range(GROUPS):
        frames = [moved(still, [0, 0.05 * t, 0], [0.01 * t, 0, 0]) for t in range(k * LENGTH, (k + 1) * LENGTH)]
        life = np.tile(np.array([0, LENGTH], np.int32), (n, 1))
        life[: n // 4, 1] = LENGTH // 2
        groups.append(Group(frames, life if k % 2 else None))
    return GaussianSequence(FPS, groups)


def cameras() -> list[Camera]:
    """Two reference cameras with off-centre axes."""
    from gscodec.camera import look_at

    K = np.array([[300.0, 0, 130], [0, 290, 90], [0, 0, 1]])
    eyes = ([3.0, 0.5, -2], [-2.5, 1, 2.5])
    return [
        Camera(f"cam{i}", K, look_at(np.array(e), np.zeros(3), np.array([0, 1.0, 0])), 256, 192)
        for i, e in enumerate(eyes)
    ]


@pytest.fixture(scope="module")
def gsv(tmp_path_factory) -> Path:
    """A stream of 5 groups of 6 frames."""
    path = tmp_path_factory.mktemp("player") / "a.gsv"
    s = sequence(sh_count=3)
    config = stream_config(
        fps=FPS, sh_degree=1, gaussians=400, frames=LENGTH, cameras=cameras(), background=(0.2, 0.3, 0.5)
    )
    encode_groups(lambda done: iter(s.groups[done:]), path, config, EncodeSettings(quality=80), fingerprint={})
    return path


def serving(server: http.server.HTTPServer):
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server


@pytest.fixture(scope="module")
def server(gsv):
    s = serving(Server(gsv))
    yield s
    s.shutdown()
    s.server_close()


def ask(server, path="/stream.gsv", method="GET", **headers):
    """(status, headers, body) of a request."""
    c = http.client.HTTPConnection(*server.server_address[:2], timeout=10)
    c.request(method, path, headers={k.replace("_", "-"): v for k, v in headers.items()})
    r = c.getresponse()
    body = r.read()
    c.close()
    return r.status, dict(r.getheaders()), body


# The server


def test_the_whole_file(server, gsv):
    status, headers, body = ask(server)
    assert (status, body) == (200, gsv.read_bytes())
    assert headers["Accept-Ranges"] == "bytes"
    assert int(headers["Content-Length"]) == len(body)


@pytest.mark.parametrize(
    ("value", "start", "end"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=5-9", 5, 10),
        ("bytes=7-", 7, None),
        ("bytes=-4", -4, None),
        ("bytes=3-99999999", 3, None),
        ("bytes=-99999999", 0, None),
    ],
)
def test_ranges(server, gsv, value, start, end):
    data = gsv.read_bytes()
    status, headers, body = ask(server, Range=value)
    assert (status, body) == (206, data[start:end])
    first = start % len(data)
    assert headers["Content-Range"] == f"bytes {first}-{first + len(body) - 1}/{len(data)}"
    assert int(headers["Content-Length"]) == len(body)


@pytest.mark.parametrize("value", ["bytes=99999999-", "bytes=-0"])
def test_a_range_outside_of_the_file(server, gsv, value):
    status, headers, body = ask(server, Range=value)
    assert (status, body) == (416, b"")
    assert headers["Content-Range"] == f"bytes */{gsv.stat().st_size}"


@pytest.mark.parametrize("value", ["bytes=9-5", "bytes=-", "bytes=a-b", "lines=1-2", "bytes=0-1,4-5", "", "bytes=--5"])
def test_a_range_that_is_none_is_ignored(server, gsv, value):
    status, _, body = ask(server, Range=value)
    assert (status, len(body)) == (200, gsv.stat().st_size)


def test_ranges_of_an_empty_file():
    assert parse_range(None, 0) is None
    for value in ("bytes=0-", "bytes=-1"):
        with pytest.raises(ValueError, match="range"):
            parse_range(value, 0)


def test_head(server, gsv):
    status, headers, body = ask(server, method="HEAD", Range="bytes=0-1")
    assert (status, body) == (200, b"")
    assert int(headers["Content-Length"]) == gsv.stat().st_size


def test_if_range(server, gsv):
    _, headers, _ = ask(server, method="HEAD")
    for value, status in [
        (headers["ETag"], 206),
        ('"another"', 200),
        ("W/" + headers["ETag"], 200),
        (headers["Last-Modified"], 206),
        (formatdate(0, usegmt=True), 200),
        ("nonsense", 200),
    ]:
        assert ask(server, Range="bytes=0-1", If_Range=value)[0] == status, value


def test_the_tag_changes_with_the_file(tmp_path, gsv):
    path = tmp_path / "b.gsv"
    path.write_bytes(gsv.read_bytes())
    s = serving(Server(path))
    tag = ask(s, method="HEAD")[1]["ETag"]
    assert ask(s, method="HEAD")[1]["ETag"] == tag
    path.write_bytes(gsv.read_bytes() + b"x")
    assert ask(s, method="HEAD")[1]["ETag"] != tag
    s.shutdown()


def test_only_the_stream_and_the_page(server):
    for path in ("/", *(f"/{name}" for name in FILES)):
        status, headers, body = ask(server, path)
        assert status == 200, path
        assert body
        assert headers["Content-Type"] == FILES[path[1:] or "index.html"]
    outside = (
        "/server.py",
        "/build.py",
        "/../pyproject.toml",
        "/%2e%2e/pyproject.toml",
        "//etc/passwd",
        "/a.gsv",
        "/..",
    )
    for path in outside:
        assert ask(server, path)[0] == 404, path
    assert ask(server, "/", method="POST")[0] == 501
    assert {f.name for f in PAGE.iterdir() if f.suffix in (".html", ".js", ".css", ".wasm")} == set(FILES)


def test_it_serves_this_machine_only_unless_asked(server):
    assert server.server_address[0] == "127.0.0.1"
    assert server.url.startswith("http://127.0.0.1:")


def test_a_port_in_use_is_said(server, gsv):
    with pytest.raises(UsageError, match="--port"):
        Server(gsv, port=server.server_address[1])
    with pytest.raises(UsageError, match="--port"):
        Server(gsv, port=99999)
    with pytest.raises(FileNotFoundError):
        Server(gsv.with_name("nothing.gsv"))


def test_a_growing_file_stays_readable_when_it_is_replaced(tmp_path, gsv):
    data, part = gsv.read_bytes(), tmp_path / "a.gsv.part"
    part.write_bytes(data[:1000])
    s = serving(Server(part))
    assert len(ask(s)[2]) == 1000
    with open(part, "ab") as f:
        f.write(data[1000:2000])
    assert ask(s, Range="bytes=1000-")[2] == data[1000:2000]
    part.unlink()
    assert ask(s)[2] == data[:2000]
    s.shutdown()


def test_a_viewer_that_leaves_does_no_harm(server, gsv):
    for _ in range(3):
        c = socket.create_connection(server.server_address[:2])
        c.sendall(b"GET /stream.gsv HTTP/1.1\r\nHost: a\r\n\r\n")
        c.close()
    assert ask(server)[0] == 200


def test_the_command_prints_the_address_and_ends_with_ctrl_c(gsv):
    code = "from gscodec.cli import main; main()"
    command = [sys.executable, "-c", code, "play", str(gsv), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as p:
        line = p.stdout.readline()
        address = line.split("http://")[1].split("/")[0]
        c = http.client.HTTPConnection(address, timeout=10)
        c.request("GET", "/stream.gsv", headers={"Range": "bytes=4-11"})
        assert c.getresponse().read() == b"ftypgsv1"
        c.close()
        p.send_signal(signal.SIGINT)
        assert p.wait(20) == 0
        assert "Traceback" not in p.stderr.read()


def test_the_command_refuses_what_is_no_stream(tmp_path):
    (tmp_path / "a.gsv").write_bytes(b"this is not a stream")
    code = "from gscodec.cli import main; main()"
    for name, word in (("a.gsv", "a.gsv"), ("none.gsv", "No such file")):
        command = [sys.executable, "-c", code, "play", str(tmp_path / name), "--no-browser"]
        r = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert r.returncode == 1
        assert word in r.stderr
        assert "Traceback" not in r.stderr


# The built files


def test_the_built_files_are_those_of_the_sources():
    spec = importlib.util.spec_from_file_location("build", ROOT / "player" / "build.py")
    build = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(build)
    assert build.HASH.read_text().strip() == build.source_hash(), "run `make player` and commit player/native.*"


def test_the_player_is_small():
    size = sum((PAGE / name).stat().st_size for name in FILES)
    assert size <= 500_000


def test_nothing_of_the_builders_machine_is_in_the_module():
    data = (PAGE / "native.wasm").read_bytes()
    for word in (b"/root/", b"/home/", b"/tmp/", str(ROOT).encode()):
        assert word not in data


# The page


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if find_chromium() is None:
        if os.environ.get("CI"):
            pytest.fail("no Chromium: set CHROMIUM or install it")
        pytest.skip("no Chromium here (Debian: apt-get install chromium)")
    b = Browser(tmp_path_factory.mktemp("profile"))
    yield b
    b.close()


PLAYER = "document.querySelector('gsv-player')"


def part(selector: str) -> str:
    return f"{PLAYER}.shadowRoot.querySelector({json.dumps(selector)})"


def load(browser, url, **options) -> None:
    """Opens the page and waits for the first picture."""
    query = "&".join(f"{k}={v}" for k, v in options.items())
    browser.goto(f"{url}?{query}" if query else url)
    browser.wait(f"{PLAYER}.camera && {PLAYER}.stats.gaussians > 0")


def canvas(browser) -> np.ndarray:
    """[H, W, 3] u8: what is on the canvas."""
    script = f"""(() => {{
        const c = {part("canvas")};
        const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
        let s = ""; for (let i = 0; i < d.length; i += 8192) s += String.fromCharCode(...d.subarray(i, i + 8192));
        return [c.width, c.height, btoa(s)];
    }})()"""
    w, h, data = browser.eval(script)
    return np.frombuffer(base64.b64decode(data), np.uint8).reshape(h, w, 4)[..., :3]


def camera_of(view: list[float]) -> Camera:
    w, h, fx, fy, cx, cy, *m = view
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return Camera("view", K, np.array([*m, 0, 0, 0, 1.0]).reshape(4, 4), int(w), int(h))


def show(browser, t: int) -> Camera:
    """Stops at frame `t`; the camera it is seen with."""
    return camera_of(browser.eval(f"{PLAYER}.show({t}).then((d) => Array.from(d.view))"))


def psnr(a, b) -> float:
    return 10 * np.log10(255**2 / max(np.mean((a.astype(float) - b) ** 2), 1e-9))


def notes(browser) -> str:
    return browser.eval(f"{part('.notes')}.innerText")


def test_the_picture_is_that_of_the_renderer(browser, server, gsv):
    load(browser, server.url, size="320x200", autoplay="off")
    stream = open_stream(gsv)
    background = tuple(stream.config["background"])
    for t in (0, LENGTH + 5, 3 * LENGTH + 1):  # with lifetimes and without
        camera = show(browser, t)
        assert (camera.width, camera.height) == (320, 200)
        want = render_image(stream.frame(t), camera, background)
        got = canvas(browser)
        assert want.std() > 10
        assert psnr(got, want) >= 35
        assert np.abs(got.astype(int) - want).max() <= 2
    assert browser.errors == []


def test_reference_cameras(browser, server, gsv):
    load(browser, server.url, size="256x192", autoplay="off")
    options = browser.eval(f"[...{part('[data-set=view]')}.options].map((o) => o.text)")
    assert options == ["Free view", "cam0", "cam1"]
    browser.eval(f"{PLAYER}.camera.use(1)")
    show(browser, 2)
    stream = open_stream(gsv)
    want = render_image(stream.frame(2), stream.cameras[1], tuple(stream.config["background"]))
    assert psnr(canvas(browser), want) >= 35
    before = browser.eval(f"Array.from({PLAYER}.camera.view(256, 192))")
    browser.eval(f"{PLAYER}.camera.orbit(0, 0)")  # a drag goes on from there
    after = browser.eval(f"Array.from({PLAYER}.camera.view(256, 192))")
    np.testing.assert_allclose(np.array(after)[6:], np.array(before)[6:], atol=2e-3)


def test_it_plays_loops_and_ends(browser, server):
    load(browser, server.url, size="160x120")
    browser.wait(f"{PLAYER}.frame > {LENGTH + 2}")
    browser.wait(f"{PLAYER}.frame < {LENGTH}")  # around
    assert not browser.eval(f"{PLAYER}.paused")
    browser.eval(f"{PLAYER}.removeAttribute('loop')")
    browser.wait(f"{PLAYER}.paused")
    assert browser.eval(f"{PLAYER}.frame") == GROUPS * LENGTH - 1
    browser.eval(f"{PLAYER}.play()")
    browser.wait(f"{PLAYER}.frame < 5")
    assert browser.errors == []


def test_keys_and_buttons(browser, server):
    load(browser, server.url, size="160x120", autoplay="off")
    browser.eval(f"{part('.stage')}.focus()")
    frame = lambda: browser.eval(f"{PLAYER}.frame")  # noqa: E731
    show(browser, 7)
    browser.key("ArrowRight")
    assert frame() == 8
    browser.key("ArrowLeft")
    browser.key("ArrowLeft")
    assert frame() == 6
    browser.key("End")
    assert frame() == GROUPS * LENGTH - 1
    browser.key("Home")
    assert frame() == 0
    browser.key(" ")
    assert not browser.eval(f"{PLAYER}.paused")
    browser.key(" ")
    assert browser.eval(f"{PLAYER}.paused")
    looping = browser.eval(f"{PLAYER}.loop")
    browser.key("l")
    assert browser.eval(f"{PLAYER}.loop") != looping
    browser.key("s")
    assert "Gaussians" in browser.wait(f"{part('.stats')}.textContent")
    browser.eval(f"{part('[data-do=play]')}.click()")
    assert not browser.eval(f"{PLAYER}.paused")
    browser.eval(
        f"{part('[data-set=speed]')}.value = '2'; {part('[data-set=speed]')}.dispatchEvent(new Event('change', {{bubbles: true}}))"
    )
    assert browser.eval(f"{PLAYER}.speed") == 2


def test_drags_turn_move_and_zoom(browser, server):
    load(browser, server.url, autoplay="off")
    view = lambda: browser.eval(f"Array.from({PLAYER}.camera.view(100, 100)).slice(6)")  # noqa: E731
    start = view()
    browser.drag((600, 300), (700, 340))
    turned = view()
    assert np.abs(np.subtract(turned, start)).max() > 0.1
    browser.drag((600, 300), (700, 340), "right")
    panned = np.array(view()).reshape(3, 4)
    np.testing.assert_allclose(panned[:, :3], np.array(turned).reshape(3, 4)[:, :3], atol=1e-6)
    assert abs(panned[0, 3] - turned[3]) > 0.1
    depth = panned[2, 3]
    browser.wheel(600, 300, -300)
    browser.wait(f"{PLAYER}.camera.view(9, 9)[17] < {depth - 0.1}")
    browser.eval(f"{part('[data-do=reset]')}.click()")
    np.testing.assert_allclose(view(), start, atol=1e-6)


def test_scrubbing_shows_the_frame(browser, server, gsv):
    load(browser, server.url, size="160x120", autoplay="off")
    stream = open_stream(gsv)
    r = np.random.default_rng(1)
    for t in r.integers(0, GROUPS * LENGTH, 8).tolist():
        want = render_image(stream.frame(t), show(browser, t), tuple(stream.config["background"]))
        assert psnr(canvas(browser), want) >= 35, t
    bar = part(".seek input")
    browser.eval(f"{bar}.value = 20; {bar}.dispatchEvent(new Event('input', {{bubbles: true}}))")
    assert browser.eval(f"{PLAYER}.frame") == 20


def test_a_phone(browser, server, tmp_path):
    try:
        browser.resize(390, 844, mobile=True, scale=2)
        load(browser, server.url)
        assert browser.eval("document.documentElement.scrollWidth") <= 390
        for name in ("play", "loop", "reset", "stats"):
            x, y, w, h = browser.eval(
                f"(({{x, y, width, height}}) => [x, y, width, height])({part(f'[data-do={name}]')}.getBoundingClientRect())"
            )
            assert x >= 0
            assert x + w <= 390
            assert y + h <= 844
            assert min(w, h) >= 36
        browser.screenshot(tmp_path / "phone.png")
    finally:
        browser.resize(1280, 800)


# Other servers, and trouble


class Trouble(http.server.BaseHTTPRequestHandler):
    """A plain server with Range and CORS, and what may go wrong with one."""

    protocol_version = "HTTP/1.1"
    data = b""
    log: list
    drop_after: int | None = None  # bytes of a body after which the connection is cut
    fail_first = 0
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
            time.sleep(0.2)  # what was sent arrives before the news that it is all
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


@pytest.fixture
def other(gsv):
    """Starts servers of another origin: other(data, **what goes wrong) -> URL, handler."""
    started = []

    def start(data, **attributes):
        path = attributes.pop("path", "/some/where.gsv")
        handler = type("T", (Trouble,), {"data": data, "log": [], **attributes})
        s = serving(http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler))
        started.append(s)
        return f"http://127.0.0.1:{s.server_address[1]}{path}", handler

    yield start
    for s in started:
        s.shutdown()
        s.server_close()


def error_text(browser) -> str:
    return browser.wait(f"!{part('.error')}.hidden && {part('.error')}.innerText")


def test_a_file_from_another_server(browser, server, gsv, other):
    url, handler = other(gsv.read_bytes())
    load(browser, server.url, src=url, size="160x120", autoplay="off")
    stream = open_stream(gsv)
    want = render_image(stream.frame(9), show(browser, 9), tuple(stream.config["background"]))
    assert psnr(canvas(browser), want) >= 35
    assert all(value.startswith("bytes=") for value in handler.log)


class Static(http.server.SimpleHTTPRequestHandler):
    """What a static host with CORS does; it ignores ranges."""

    def end_headers(self):
        self.send_header("Access-Control-Allow-Origin", "*")
        super().end_headers()

    def log_message(self, *args):
        pass


def test_the_element_on_another_page(browser, gsv, other, tmp_path):
    """Page, player and file on three origins; the element is taken out and put back."""
    make = lambda *a, **k: Static(*a, directory=str(PAGE), **k)  # noqa: E731
    host = serving(http.server.ThreadingHTTPServer(("127.0.0.1", 0), make))
    file, _ = other(gsv.read_bytes())
    page = f"""<!doctype html><script type=module src="http://127.0.0.1:{host.server_address[1]}/player.js"></script>
        <gsv-player src="{file}" size="64x64" style="width: 300px; height: 200px"></gsv-player>"""
    url, _ = other(page.encode(), kind="text/html")
    browser.goto(url)
    playing = f"{PLAYER}.camera && {PLAYER}.stats.gaussians > 0"
    browser.wait(playing)
    assert browser.eval(f"{PLAYER}.paused"), "no autoplay was asked for"
    browser.eval(f"{{ const p = {PLAYER}; p.remove(); document.body.append(p); p.camera = null; }}")
    browser.wait(playing)
    assert browser.eval(f"{PLAYER}.getBoundingClientRect().height") == 200
    host.shutdown()


@pytest.mark.parametrize(("rate", "rung"), [(20_000, 1), (None, 2)])
def test_a_ladder_is_played_at_the_rate_of_the_link(browser, server, gsv, other, rate, rung):
    """Two qualities of one capture; `rate` in bytes a second, None: unlimited."""
    s = sequence()
    small = gsv.with_name("small.gsv")
    if not small.exists():
        config = stream_config(fps=FPS, sh_degree=0, gaussians=400, frames=LENGTH)
        encode_groups(lambda done: iter(s.groups[done:]), small, config, EncodeSettings(quality=10), fingerprint={})
    rungs = []
    for path in (gsv, small):
        url, handler = other(path.read_bytes(), rate=rate)
        bandwidth = 8 * path.stat().st_size * FPS // (GROUPS * LENGTH)
        rungs.append(f'<Representation id="{path.stem}" bandwidth="{bandwidth}"><BaseURL>{url}</BaseURL></Representation>')
    manifest = f"""<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static"><Period>
        <AdaptationSet mimeType="video/mp4">{"".join(rungs)}</AdaptationSet></Period></MPD>"""
    url, _ = other(manifest.encode(), kind="application/dash+xml", path="/a.mpd")
    load(browser, server.url, src=url, size="64x64", loop="off")
    browser.wait(f"{PLAYER}.frame > {2 * LENGTH}")
    show(browser, GROUPS * LENGTH - 1)
    assert browser.eval(f"{PLAYER}.engine.source.quality") == f"{rung} of 2"


def test_a_manifest_of_nothing(browser, server, other):
    url, _ = other(b"<MPD/>", path="/a.mpd")
    browser.goto(f"{server.url}?src={url}")
    assert "names no files" in error_text(browser)


def test_a_seek_fetches_what_it_needs(browser, server, other, tmp_path):
    """A file whose groups are larger than the first request: the one that is looked at, and no other but the next."""
    s = sequence(6000)
    path = tmp_path / "large.gsv"
    config = stream_config(fps=1, sh_degree=0, gaussians=6000, frames=LENGTH)
    encode_groups(lambda done: iter(s.groups[done:]), path, config, EncodeSettings(quality=95), fingerprint={})
    groups = open_stream(path).groups
    assert groups[0]["size"] > 70_000
    url, handler = other(path.read_bytes())
    load(browser, server.url, src=url, size="64x64", autoplay="off", loop="off")
    browser.eval(f"{PLAYER}.show({4 * LENGTH})")
    asked = [tuple(map(int, value[6:].split("-"))) for value in handler.log]
    touched = {
        i for i, g in enumerate(groups) for a, b in asked[1:] if a < g["offset"] + g["size"] and b >= g["offset"]
    }
    assert 4 in touched
    assert len(asked) < 8
    assert {0, 4} <= touched


def test_a_server_without_ranges(browser, server, gsv, other):
    url, handler = other(gsv.read_bytes(), ranges=False)
    load(browser, server.url, src=url, size="64x64", autoplay="off")
    show(browser, GROUPS * LENGTH - 1)
    assert len(handler.log) == 1


def test_a_server_that_drops_the_connection(browser, server, gsv, other):
    url, handler = other(gsv.read_bytes(), drop_after=3000)
    load(browser, server.url, src=url, size="64x64", autoplay="off")
    show(browser, GROUPS * LENGTH - 1)
    starts = [int(value[6:].split("-")[0]) for value in handler.log]
    assert {3000, 6000, 9000} <= set(starts), "it goes on where it broke"


def test_a_server_that_is_busy(browser, server, gsv, other):
    url, handler = other(gsv.read_bytes(), fail_first=2)
    load(browser, server.url, src=url, size="64x64", autoplay="off")
    assert len(handler.log) >= 3


def test_a_server_that_is_gone(browser, server):
    browser.goto(f"{server.url}?src=nothing.gsv")
    assert "not found" in error_text(browser)
    browser.goto(f"{server.url}?src=http://127.0.0.1:9/a.gsv")
    assert "Trying again" in browser.wait(f"{part('.notes')}.innerText")


def test_a_file_that_is_no_stream(browser, server, other):
    for data, word in (
        (b"not a stream at all, but long enough", "ftyp"),
        (b"", "empty"),
        (b"\0\0\0\x14ftypgsv1", "ends before"),
    ):
        url, _ = other(data)
        browser.goto(f"{server.url}?src={url}")
        assert word in error_text(browser)
        assert browser.eval(f"{part('[data-do=retry]')}.checkVisibility()")


def test_a_damaged_group_is_left_out(browser, server, gsv, other):
    data = bytearray(gsv.read_bytes())
    g = open_stream(gsv).groups[2]
    data[g["offset"] + g["size"] // 2] ^= 1
    url, _ = other(bytes(data))
    load(browser, server.url, src=url, size="64x64")
    browser.wait(f"{PLAYER}.frame > {3 * LENGTH}")
    text = notes(browser)
    assert f"Frames {2 * LENGTH}–{3 * LENGTH - 1} are damaged" in text
    assert "CRC" in text
    assert browser.eval(f"{part('.error')}.hidden")


def test_a_file_that_is_all_damage(browser, server, gsv, other):
    data = bytearray(gsv.read_bytes())
    for g in open_stream(gsv).groups:
        data[g["offset"] + g["size"] // 2] ^= 1
    url, _ = other(bytes(data))
    browser.goto(f"{server.url}?src={url}")
    assert "damaged" in error_text(browser)


@pytest.mark.parametrize("indexed", [True, False])
def test_a_truncated_file(browser, server, gsv, other, indexed):
    data = gsv.read_bytes()
    g = open_stream(gsv).groups[3]
    if not indexed:
        at = data.index(b"sidx")
        data = data[:at] + b"free" + data[at + 4 :]
    url, _ = other(data[: g["offset"] + 20])
    load(browser, server.url, src=url, size="64x64", autoplay="off")
    assert browser.wait(f"{PLAYER}.frameCount >= {3 * LENGTH} && {PLAYER}.frameCount") == 3 * LENGTH
    show(browser, 3 * LENGTH - 1)
    text = notes(browser)
    assert (f"{3 * LENGTH} of {GROUPS * LENGTH} frames" if indexed else "still being written") in text


def test_a_growing_file(browser, tmp_path, gsv):
    """Bytes as an encoder adds them, without index and cut anywhere."""
    data = gsv.read_bytes()
    at = data.index(b"sidx") - 4
    data = data[:at] + data[at + int.from_bytes(data[at : at + 4], "big") :]
    path = tmp_path / "live.gsv.part"
    first = len(data) // 3
    path.write_bytes(data[:first])
    s = serving(Server(path))
    load(browser, s.url, size="64x64")
    seen = browser.eval(f"{PLAYER}.frameCount")
    assert 0 < seen < GROUPS * LENGTH
    assert "still being written" in notes(browser)
    for end in (first + 10, first + 2000, len(data)):
        with open(path, "ab") as f:
            f.write(data[path.stat().st_size : end])
        time.sleep(0.3)
    browser.wait(f"{PLAYER}.frame >= {GROUPS * LENGTH - 1}")
    s.shutdown()


def test_an_old_browser_is_told(browser, server):
    script = browser.call("Page.addScriptToEvaluateOnNewDocument", source="WebAssembly.validate = () => false")
    browser.goto(server.url)
    assert "SIMD" in error_text(browser)
    browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=script["identifier"])
