"""A server with what huggingface_hub's client asks of the hub, for models and data sets."""

import base64
import contextlib
import dataclasses
import hashlib
import http.server
import json
import threading
import urllib.parse
from collections.abc import Iterator

import pytest

COMMIT = "0123456789abcdef0123456789abcdef01234567"


@dataclasses.dataclass
class Hub:
    """Repositories by their names, and what was asked for."""

    port: int = 0
    repositories: dict[str, dict[str, bytes]] = dataclasses.field(default_factory=dict)
    """Name, with datasets/ before that of a data set, -> path -> bytes."""
    asked: list[tuple[str, str, str | None]] = dataclasses.field(default_factory=list)
    """Method, path and token of all requests."""
    refused: int | None = None
    """Code of all answers."""
    cards: list[str] = dataclasses.field(default_factory=list)
    """Cards that were sent to be checked."""
    messages: list[str] = dataclasses.field(default_factory=list)
    """Messages of all commits."""


class _Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *arguments: object) -> None:
        pass

    def _answer(self, code: int, body: bytes = b"", **headers: str) -> None:
        self.send_response(code)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def _json(self, value: object) -> None:
        self._answer(200, json.dumps(value).encode(), Content_Type="application/json")

    def _handle(self) -> None:
        hub: Hub = self.server.hub  # pyright: ignore
        path = urllib.parse.unquote(self.path.partition("?")[0])
        hub.asked.append((self.command, path, self.headers.get("Authorization")))
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if hub.refused is not None:
            self._answer(hub.refused)
        elif "/resolve/" in path:
            self._file(hub, *path.strip("/").split("/resolve/"))
        elif path == "/api/repos/create":
            name = json.loads(body)
            name = "/".join(filter(None, [name.get("organization"), name["name"]]))
            name = name if "/" in name else f"nobody/{name}"
            hub.repositories.setdefault(name, {})
            self._json({"url": f"http://127.0.0.1:{self.server.server_address[1]}/{name}"})  # pyright: ignore
        elif path == "/api/validate-yaml":  # of a card, which the hub reads as YAML
            hub.cards.append(json.loads(body)["content"])
            self._json({"errors": [], "warnings": []})
        elif path.startswith("/api/models/"):
            self._model(hub, path.removeprefix("/api/models/"), body)
        else:
            self._answer(404)

    do_GET = do_HEAD = do_POST = _handle

    def _file(self, hub: Hub, name: str, rest: str) -> None:
        revision, _, file = rest.partition("/")
        if name not in hub.repositories:
            self._answer(401, X_Error_Code="RepoNotFound")
        elif revision not in ("main", COMMIT):
            self._answer(404, X_Error_Code="RevisionNotFound")
        elif file not in hub.repositories[name]:
            self._answer(404, X_Error_Code="EntryNotFound", X_Repo_Commit=COMMIT)
        else:
            data = hub.repositories[name][file]
            etag = hashlib.sha1(data).hexdigest()
            self._answer(200, data, ETag=f'"{etag}"', X_Repo_Commit=COMMIT)

    def _model(self, hub: Hub, path: str, body: bytes) -> None:
        name, _, rest = ("/".join(path.split("/")[:2]), "", "/".join(path.split("/")[2:]))
        files = hub.repositories.get(name)
        if files is None:
            self._answer(401, X_Error_Code="RepoNotFound")
        elif rest.startswith("preupload/"):
            asked = json.loads(body)["files"]
            self._json(
                {
                    "files": [
                        {"path": each["path"], "uploadMode": "regular", "shouldIgnore": False}
                        for each in asked
                    ]
                }
            )
        elif rest.startswith("commit/"):
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    files[line["value"]["path"]] = base64.b64decode(line["value"]["content"])
                else:
                    hub.messages.append(line["value"]["summary"])
            url = f"http://127.0.0.1/{name}/commit/{COMMIT}"
            self._json({"commitUrl": url, "commitOid": COMMIT})
        elif rest.startswith("tree/"):
            self._json(
                [
                    {"type": "file", "path": each, "size": len(data), "oid": "0"}
                    for each, data in files.items()
                ]
            )
        else:
            siblings = [{"rfilename": each} for each in files]
            self._json({"id": name, "modelId": name, "sha": COMMIT, "siblings": siblings})


@contextlib.contextmanager
def hub_server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """Serve while the block runs; huggingface_hub's client asks this hub, and stores nothing."""
    import huggingface_hub.constants as constants

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
    server.daemon_threads = True
    hub = server.hub = Hub(server.server_address[1])  # pyright: ignore
    url = f"http://127.0.0.1:{hub.port}"
    # What HF_ENDPOINT sets, which the client reads once, when it is imported.
    monkeypatch.setattr(constants, "ENDPOINT", url)
    template = url + "/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    for name in ("http_proxy", "https_proxy", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
