"""The server of `gscodec play` and its byte ranges; the files that `make player` builds."""

import contextlib
import gzip
import http.client
import importlib.util
import signal
import socket
import subprocess
import sys
from email.utils import formatdate
from pathlib import Path

import pytest
from playing import ask, serving

from gscodec.errors import UsageError
from gscodec.player.export import export_page
from gscodec.player.server import FILES, PAGE, Server, parse_range

ROOT = Path(__file__).parent.parent


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
    modules = {f.name for f in player_build().page_modules()}  # modules bundled in page.js
    assert {f.name for f in PAGE.iterdir() if f.suffix in (".html", ".js", ".css", ".gz")} == set(FILES) | modules
    for name in modules - set(FILES):
        assert ask(server, f"/{name}")[0] == 404, name


def test_the_page_is_packed_and_sent_once(server):
    for name in ("page.js", "native.wasm.gz"):
        plain = (PAGE / name).read_bytes()
        status, headers, body = ask(server, f"/{name}", Accept_Encoding="gzip, br")
        assert (status, headers.get("Content-Encoding")) == (200, "gzip" if name == "page.js" else None)
        assert (gzip.decompress(body) if name == "page.js" else body) == plain
        status, headers, body = ask(server, f"/{name}", Accept_Encoding="gzip, br", If_None_Match=headers["ETag"])
        assert (status, body) == (304, b"")
        assert "Content-Length" not in headers
        assert ask(server, f"/{name}", If_None_Match='"another"')[2] == plain


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


@contextlib.contextmanager
def started(command):
    """A process that takes Ctrl-C also if the tests run in the background, and always ends with them."""
    listen = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)  # noqa: E731
    p = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=listen)
    try:
        yield p
    finally:
        p.kill()
        p.communicate()


def test_the_command_prints_the_address_and_ends_with_ctrl_c(gsv):
    code = "from gscodec.cli import main; main()"
    command = [sys.executable, "-c", code, "play", str(gsv), "--no-browser"]
    with started(command) as p:
        line = p.stdout.readline()
        address = line.split("http://")[1].split("/")[0]
        c = http.client.HTTPConnection(address, timeout=10)
        c.request("GET", "/stream.gsv", headers={"Range": "bytes=4-11"})
        assert c.getresponse().read() == b"ftypgsv1"
        c.close()
        p.send_signal(signal.SIGINT)
        assert p.wait(20) == 0
        assert "Traceback" not in p.stderr.read()


def test_the_command_finds_the_file_that_is_being_written(tmp_path, gsv):
    (tmp_path / "a.gsv.part").write_bytes(gsv.read_bytes())
    code = "from gscodec.cli import main; main()"
    command = [sys.executable, "-c", code, "play", str(tmp_path / "a.gsv"), "--no-browser"]
    with started(command) as p:
        assert "a.gsv.part plays at http://127.0.0.1:" in p.stdout.readline()
    with started([*command, "--track", "1:name=b"]) as p:
        assert "a.gsv.part plays at http://127.0.0.1:" in p.stdout.readline()
    r = subprocess.run([*command, "--export", str(tmp_path / "page")], capture_output=True, text=True, timeout=60)
    assert "a.gsv.part cannot be exported under its name: expected a finished stream" in r.stderr


def test_the_command_refuses_what_is_no_stream(tmp_path):
    (tmp_path / "a.gsv").write_bytes(b"this is not a stream")
    code = "from gscodec.cli import main; main()"
    for name, word in (("a.gsv", "a.gsv"), ("none.gsv", "No such file")):
        command = [sys.executable, "-c", code, "play", str(tmp_path / name), "--no-browser"]
        r = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert r.returncode == 1
        assert word in r.stderr
        assert "Traceback" not in r.stderr


def test_an_exported_folder_is_for_any_static_host(tmp_path, gsv):
    code = "from gscodec.cli import main; main()"
    stream = tmp_path / "a film.gsv"
    stream.write_bytes(gsv.read_bytes())
    command = [sys.executable, "-c", code, "play", str(stream), "--export", str(tmp_path / "movies")]
    for _ in range(2):
        r = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert r.returncode == 0, r.stderr
        assert '<iframe src="movies/index.html?src=a%20film.gsv"' in r.stdout
        assert {f.name for f in (tmp_path / "movies").iterdir()} == {*FILES, "a film.gsv"}
        assert (tmp_path / "movies" / "a film.gsv").read_bytes() == gsv.read_bytes()
    with pytest.raises(UsageError, match="finished stream"):
        export_page(tmp_path / "a.gsv.part", tmp_path / "movies")
    stream = stream.rename(tmp_path / "take #2.gsv")
    assert '?src=take%20%25232.gsv"' in export_page(stream, tmp_path / "movies"), "the address of the file in a query"


def test_an_export_that_fails_leaves_no_part(tmp_path, gsv, monkeypatch):
    def full(source, to):
        to.write_bytes(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr("shutil.copyfile", full)
    with pytest.raises(OSError, match="space"):
        export_page(gsv, tmp_path / "movies")
    assert list((tmp_path / "movies").iterdir()) == []


def player_build():
    """The module player/build.py, which is not in the package."""
    spec = importlib.util.spec_from_file_location("build", ROOT / "player" / "build.py")
    build = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(build)
    return build


def test_the_built_files_are_those_of_the_sources():
    build = player_build()
    assert build.HASH.read_text().strip() == build.source_hash(), "run `make player` and commit player/native.*"
    assert build.PAGE_HASH.read_text().strip() == build.page_hashes(), "run `make player` and commit player/page.*"
    assert build.SPARK_HASH.read_text().strip() == build.spark_hashes(), "run `make spark` and commit player/spark.*"


def test_the_player_is_small():
    files = [(PAGE / name).read_bytes() for name in FILES if name != "spark.js"]  # spark.js: GPU path only
    plain = [gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data for data in files]
    assert sum(map(len, plain)) <= 500_000
    assert sum(len(gzip.compress(data)) for data in plain) <= 200_000  # bytes sent


def test_nothing_of_the_builders_machine_is_in_the_module():
    data = gzip.decompress((PAGE / "native.wasm.gz").read_bytes())
    for word in (b"/root/", b"/home/", b"/tmp/", str(ROOT).encode()):
        assert word not in data
