"""A server of files on this machine's loopback, with the faults of real ones."""

import contextlib
import dataclasses
import http.server
import threading
import time
from collections.abc import Iterator


@dataclasses.dataclass
class FileServer:
    """What the server has, how it fails, and what it was asked for."""

    port: int = 0
    files: dict[str, bytes] = dataclasses.field(default_factory=dict)
    ranges: bool = True
    etag: str | None = '"1"'
    modified: str | None = None
    length: int | None = None
    """Length that it says, in place of the file's own."""
    shift: int = 0
    """Bytes by which a part begins behind what was asked for."""
    statuses: list[int] = dataclasses.field(default_factory=list)
    """Codes of the next answers, in place of the file."""
    cuts: list[int] = dataclasses.field(default_factory=list)
    """Bytes after which the next answers break off."""
    stalls: int = 0
    """How many of the next answers stop after ten bytes, the connection open."""
    moved: dict[str, str] = dataclasses.field(default_factory=dict)
    """Paths that are elsewhere now."""
    waits: float = 0.0
    """Seconds before each answer."""
    asked: list[tuple[str, str | None]] = dataclasses.field(default_factory=list)
    """Paths and ranges of all requests."""
    released: threading.Event = dataclasses.field(default_factory=threading.Event)

    def url(self, path: str) -> str:
        """The address of a file."""
        return f"http://127.0.0.1:{self.port}{path}"


class _Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *arguments: object) -> None:
        pass

    def do_GET(self) -> None:
        state: FileServer = self.server.state  # pyright: ignore
        self.close_connection = True
        wanted = self.headers.get("Range")
        state.asked.append((self.path, wanted))
        time.sleep(state.waits)
        if state.statuses and (code := state.statuses.pop(0)) != 200:
            self.send_error(code)
        elif self.path in state.moved:
            self.send_response(302)
            self.send_header("Location", state.moved[self.path])
            self.send_header("Content-Length", "0")
            self.end_headers()
        elif self.path not in state.files:
            self.send_error(404)
        else:
            self._send(state, state.files[self.path], wanted)

    def _send(self, state: FileServer, data: bytes, wanted: str | None) -> None:
        start, condition = 0, self.headers.get("If-Range")
        if wanted is not None and state.ranges and condition in (state.etag, state.modified):
            start = int(wanted.removeprefix("bytes=").rstrip("-")) + state.shift
        if start and start >= len(data):
            self.send_error(416)
            return
        self.send_response(206 if start else 200)
        length = len(data) if state.length is None else state.length
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(data) - 1}/{length}")
        for name, value in (
            ("Content-Type", "application/octet-stream"),
            ("Content-Length", str(length - start)),
            ("ETag", state.etag),
            ("Last-Modified", state.modified),
        ):
            if value is not None:
                self.send_header(name, value)
        self.end_headers()
        data = data[start:]
        if state.cuts:
            data = data[: state.cuts.pop(0)]
        with contextlib.suppress(OSError):
            if state.stalls:
                state.stalls -= 1
                self.wfile.write(data[:10])
                self.wfile.flush()
                state.released.wait(10)
            else:
                self.wfile.write(data)


@contextlib.contextmanager
def file_server() -> Iterator[FileServer]:
    """Serve while the block runs."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
    server.daemon_threads = True
    state = server.state = FileServer(server.server_address[1])  # pyright: ignore
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    try:
        yield state
    finally:
        state.released.set()
        server.shutdown()
        thread.join()
        server.server_close()
