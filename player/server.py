"""The server behind `gscodec play`: one stream and the page's own files, by default for this machine only.

Of the stream ranges as in RFC 9110 (206, 416, HEAD, If-Range), since the page reads nothing but ranges; a range of
several parts is answered with the whole file, which the RFC allows. The page's files are packed with gzip, and not sent
again to a browser that has them. A file that is still being written (OUT.gsv.part) grows under the
same address: it is held open, so that it stays readable when the encoder replaces it by the finished file.
"""

from __future__ import annotations

import functools
import gzip
import os
import re
import socket
import zlib
from email.utils import formatdate, parsedate_to_datetime
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from gscodec.errors import UsageError

PAGE = Path(__file__).parent
# page.js is player.js with its modules, see build.py
FILES = {
    "index.html": "text/html; charset=utf-8",
    "page.js": "text/javascript; charset=utf-8",
    "gpu.js": "text/javascript; charset=utf-8",
    "spark.js": "text/javascript; charset=utf-8",
    "sound.js": "text/javascript; charset=utf-8",
    "parts.js": "text/javascript; charset=utf-8",
    "worker.js": "text/javascript; charset=utf-8",
    "native.js": "text/javascript; charset=utf-8",
    "player.css": "text/css; charset=utf-8",
    "native.wasm.gz": "application/gzip",
}
STREAM = "/stream.gsv"
PIECE = 1 << 18  # bytes read and sent at a time


def parse_range(value: str | None, size: int) -> tuple[int, int] | None:
    """The bytes [start, end) that a Range header asks for; None: the header is ignored (RFC 9110).

    Raises:
        ValueError: no byte of the range is in a file of `size` bytes.
    """
    m = re.fullmatch(r"\s*bytes\s*=\s*(\d*)\s*-\s*(\d*)\s*", value or "", re.IGNORECASE)
    if m is None or m.group(0).strip().endswith("=-"):
        return None
    first, last = m.groups()
    if not first:  # the last n bytes
        n = int(last)
        if n == 0 or size == 0:
            raise ValueError("an empty range")
        return max(size - n, 0), size
    if last and int(last) < int(first):
        return None
    if int(first) >= size:
        raise ValueError("the range starts after the end")
    return int(first), min(int(last) + 1, size) if last else size


@functools.lru_cache(maxsize=len(FILES))
def _packed(data: bytes) -> bytes:
    """`data` in gzip."""
    return gzip.compress(data, mtime=0)


class Stream:
    """The file that is served.

    Raises:
        OSError: it cannot be opened.
    """

    def __init__(self, path: Path):
        self.path = Path(path)
        self._held = open(self.path, "rb")
        if self.path.suffix != ".part":
            self._held.close()

    def open(self):
        """A file object of its own for one request."""
        if self._held.closed:
            return open(self.path, "rb")
        return os.fdopen(os.open(f"/proc/self/fd/{self._held.fileno()}", os.O_RDONLY), "rb")


class Handler(BaseHTTPRequestHandler):
    """GET and HEAD of the stream and the page."""

    protocol_version = "HTTP/1.1"
    server_version = "gscodec"
    timeout = 60
    stream: Stream

    def do_GET(self) -> None:
        self._answer(body=True)

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def log_message(self, *args) -> None:
        pass

    def _answer(self, *, body: bool) -> None:
        path = self.path.split("?", 1)[0].split("#", 1)[0]
        name = "index.html" if path == "/" else path[1:]
        try:
            if path == STREAM:
                with self.stream.open() as f:
                    self._send(f, "video/mp4", body)
            elif name in FILES:
                self._send_page(name, body)
            else:
                self._refuse(HTTPStatus.NOT_FOUND)
        except (BrokenPipeError, ConnectionError, TimeoutError):
            self.close_connection = True  # the browser closed the connection, for instance after a seek
        except FileNotFoundError:
            self._refuse(HTTPStatus.NOT_FOUND)

    def _refuse(self, status: HTTPStatus, **headers: str) -> None:
        self.send_response(status)
        for key, value in headers.items():
            self.send_header(key.replace("_", "-"), value)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _send_page(self, name: str, body: bool) -> None:
        """A file of the page: packed where the browser takes that, and only if it has none or another one."""
        data, headers = (PAGE / name).read_bytes(), {"Content-Type": FILES[name]}
        if "gzip" in self.headers.get("Accept-Encoding", "") and not name.endswith(".gz"):
            data, headers["Content-Encoding"] = _packed(data), "gzip"
        headers |= {"ETag": f'"{zlib.crc32(data):08x}-{len(data):x}"', "Vary": "Accept-Encoding"}
        known = self.headers.get("If-None-Match") == headers["ETag"]
        self.send_response(HTTPStatus.NOT_MODIFIED if known else HTTPStatus.OK)
        headers |= {"Cache-Control": "no-cache", "X-Content-Type-Options": "nosniff"}
        headers |= {} if known else {"Content-Length": str(len(data))}
        for key, value in headers.items():
            self.send_header(key, value)
        self.end_headers()
        if body and not known:
            self.wfile.write(data)

    def _send(self, f, kind: str, body: bool) -> None:
        facts = os.fstat(f.fileno())
        size = facts.st_size
        tag = f'"{facts.st_ino:x}-{facts.st_mtime_ns:x}-{size:x}"'
        status, start, end = HTTPStatus.OK, 0, size
        # RFC 9110: a range is for GET, and only if the file is still the one named by If-Range
        if self.command == "GET" and self._unchanged(tag, facts.st_mtime):
            try:
                found = parse_range(self.headers.get("Range"), size)
            except ValueError:
                self._refuse(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, Content_Range=f"bytes */{size}")
                return
            if found is not None:
                status, (start, end) = HTTPStatus.PARTIAL_CONTENT, found
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(end - start))
        if status == HTTPStatus.PARTIAL_CONTENT:
            self.send_header("Content-Range", f"bytes {start}-{end - 1}/{size}")
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("ETag", tag)
        self.send_header("Last-Modified", formatdate(facts.st_mtime, usegmt=True))
        self.send_header("Cache-Control", "no-cache")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        if body:
            self._copy(f, start, end)

    def _unchanged(self, tag: str, mtime: float) -> bool:
        """Whether If-Range, if there is one, names this file."""
        value = self.headers.get("If-Range")
        if value is None:
            return True
        if '"' in value:
            return value.strip() == tag  # weak tags (W/) never match
        try:
            return int(parsedate_to_datetime(value).timestamp()) == int(mtime)
        except ValueError:
            return False

    def _copy(self, f, start: int, end: int) -> None:
        f.seek(start)
        while start < end:
            piece = f.read(min(PIECE, end - start))
            if not piece:  # the file became shorter meanwhile: Content-Length cannot be met
                self.close_connection = True
                return
            self.wfile.write(piece)
            start += len(piece)


class Server(ThreadingHTTPServer):
    """Serves `path` and the page on `host`:`port` (0: any free port) until `shutdown`.

    Attributes:
        url: where the page is.

    Raises:
        OSError: the file cannot be opened.
        UsageError: the address cannot be used.
    """

    daemon_threads = True

    def __init__(self, path: Path, *, host: str = "127.0.0.1", port: int = 0):
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        handler = type("StreamHandler", (Handler,), {"stream": Stream(path)})
        try:
            super().__init__((host, port), handler)
        except (OSError, OverflowError) as e:
            reason = getattr(e, "strerror", None) or e
            raise UsageError(
                f"cannot serve on {host} port {port}: {reason}; choose others with --host and --port"
            ) from None

    @property
    def url(self) -> str:
        """Where the page is."""
        host, port = self.server_address[:2]
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
        return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"

    def handle_error(self, request, client_address) -> None:
        """Ignores errors of a connection; they concern one request only."""
