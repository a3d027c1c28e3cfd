"""Fixtures shared by test files: a stream, its server, a browser."""

import http.server
import os
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported; the commands set the same limit


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session):
    """Fails the session in CI (variable CI) if a test is skipped: CI has everything that the tests need."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    skipped = reporter.stats.get("skipped", []) if reporter else []
    if os.environ.get("CI") and skipped and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
        for report in skipped:
            reporter.write_line(f"skipped in CI: {report.nodeid}: {report.longrepr[-1]}")


@pytest.fixture(scope="session")
def gsv(tmp_path_factory) -> Path:
    """A stream of 5 groups of 6 frames; its harmonics turn with the nodes."""
    from playing import FPS, LENGTH, cameras, sequence
    from synthetic import encode_sequence

    from gscodec.encode.encode import stream_config
    from gscodec.encode.settings import EncodeSettings

    path = tmp_path_factory.mktemp("player") / "a.gsv"
    s = sequence(sh_count=3)
    config = stream_config(
        fps=FPS, sh_degree=1, gaussians=400, frames=LENGTH, cameras=cameras(), background=(0.2, 0.3, 0.5)
    )
    encode_sequence(s, path, config, EncodeSettings(quality=80), turned=True)
    return path


@pytest.fixture(scope="session")
def server(gsv):
    from playing import serving

    from gscodec.player.server import Server

    s = serving(Server(gsv))
    yield s
    s.shutdown()
    s.server_close()


@pytest.fixture(scope="module")
def browsers():
    from bench.browser import Browsers, find_chromium

    if find_chromium() is None:
        pytest.skip("no Chromium here (Debian: apt-get install chromium)")
    with Browsers() as b:
        yield b


@pytest.fixture(scope="module")
def browser(browsers):
    """A browser without WebGL."""
    return browsers.start("--disable-gpu", "--disable-3d-apis")


@pytest.fixture(scope="module")
def gl_browser(browsers):
    """A browser with WebGL2 in software, as Chromium offers it by a flag on machines without a GPU."""
    from bench.browser import SOFTWARE_GL

    return browsers.start(*SOFTWARE_GL)


@pytest.fixture
def other(gsv):
    """Starts servers of another origin: other(data, **faults) -> URL, handler."""
    from playing import Trouble, serving

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
