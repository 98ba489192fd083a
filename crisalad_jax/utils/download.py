"""Download a file, with retries and resumption; the target is never a partial file."""

import dataclasses
import http.client
import os
import pathlib
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from typing import Any

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, wrap_os_errors, write_json
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.version import VERSION

OFFLINE = "CRISALAD_OFFLINE"
"""Name of the environment variable that forbids use of the network."""
_CHUNK = 2**18
_MEGABYTE = 1e6
_PARTIAL, _NO_SUCH_RANGE = 206, 416
_PASSING = (408, _NO_SUCH_RANGE, 425, 429, 500, 502, 503, 504)
"""HTTP status codes after which the same request, or one for the whole file, may succeed."""
_GONE = (404, 410)
_TIMEOUT = 30.0
"""Seconds without an answer before an attempt fails."""
_ATTEMPTS = 5
"""Consecutive attempts with less than a megabyte each before the download fails."""
_PAUSE = 1.0
"""Seconds before the second attempt; the wait doubles for each further one."""


def is_offline() -> bool:
    """Return whether the environment forbids the network."""
    return os.environ.get(OFFLINE, "").lower() not in ("", "0", "false", "no")


class MissingFileError(InputError):
    """No file exists at the address."""


class _PassingFault(Exception):
    """A fault after which the same request may succeed."""


def download(url: str, target: pathlib.Path, *, label: str, quiet: bool = False) -> None:
    """Download a file to `target`, which appears only when it is complete.

    What has arrived of an unfinished download stays in `target`.part, with the server's
    description of the file. The next call resumes from there if the server still has the same
    file: the same length, and the same ETag or modification time. If the server gives neither, the
    next call starts again.

    Proxies are those of the environment: `http_proxy`, `https_proxy`, `no_proxy`.

    Args:
        url: an http, https or file URL.
        target: the file, in an existing folder that no other process writes to.
        label: text in front of the progress bar.
        quiet: whether to hide the progress bar.

    Raises:
        MissingFileError: the file does not exist.
        InputError: the server refuses, stalls or fails in every attempt; or the file cannot be
            written, for example to a full disk, in which case the unfinished file is removed.

    Example:
        >>> _ = (folder / "there.txt").write_text("all of it")
        >>> target = folder / "here.txt"
        >>> download((folder / "there.txt").as_uri(), target, label="text", quiet=True)
        >>> target.read_text()
        'all of it'
    """
    part, failures = _Part(target), 0
    while True:
        before = part.size()
        try:
            _fetch(url, part, label, quiet)
            break
        except _PassingFault as fault:
            failures = 1 if part.size() - before >= _MEGABYTE else failures + 1
            if failures >= _ATTEMPTS:
                raise InputError(
                    f"{url}: {fault}, expected the whole file (attempts: {failures}; the same "
                    "command resumes)"
                ) from fault
            time.sleep(_PAUSE * 2 ** (failures - 1))
    with wrap_os_errors(target):
        os.replace(part.path, target)
        part.discard()


@dataclasses.dataclass(frozen=True)
class _Remote:
    """A server's description of a file, which identifies its beginning later."""

    url: str
    length: int | None
    validator: str | None
    """Its strong ETag (files with equal weak ones may differ), else its modification time."""


class _Part:
    """An unfinished file, and a note of which file it is the beginning of."""

    def __init__(self, target: pathlib.Path) -> None:
        self.target = target
        self.path = target.with_name(f"{target.name}.part")
        self._note = target.with_name(f"{target.name}.part.json")

    def size(self) -> int:
        return self.path.stat().st_size if self.path.is_file() else 0

    def begin(self, remote: _Remote) -> None:
        self.discard()  # first: a note describes the bytes next to it
        write_json(self._note, dataclasses.asdict(remote))

    def discard(self) -> None:
        self.path.unlink(missing_ok=True)
        self._note.unlink(missing_ok=True)

    def begun(self, url: str) -> _Remote | None:
        """Return which file was begun; None if a different file would not be noticed."""
        try:
            begun = _Remote(**read_json(self._note, "a note of a download"))
        except InputError:
            return None
        known = begun.url == url and begun.validator
        return begun if known and 0 < self.size() <= (begun.length or 0) else None


def _fetch(url: str, part: _Part, label: str, quiet: bool) -> None:
    """Fetch the file, or what is missing after its beginning.

    Raises:
        _PassingFault: not all of it arrived, or it is not the file that was begun.
        InputError: what `download` raises.
    """
    begun = part.begun(url)
    start = part.size() if begun else 0
    if begun and start == begun.length:
        return
    headers = {"User-Agent": f"crisalad-jax/{VERSION}", "Accept-Encoding": "identity"}
    if begun:
        headers |= {"Range": f"bytes={start}-", "If-Range": str(begun.validator)}
    with _open(url, headers, part) as response:
        remote, span = _remote(url, response.headers), response.headers.get("Content-Range", "")
        if not begun or response.status != _PARTIAL:
            start = 0  # the whole file, whether or not its beginning is here
        # An answer to `If-Range` need not repeat the modification time.
        elif not span.startswith(f"bytes {start}-") or remote not in (
            begun,
            dataclasses.replace(begun, validator=None),
        ):
            part.discard()
            raise _PassingFault("found another file than the one that was begun")
        whole, done = (remote.length or 0) / _MEGABYTE, start / _MEGABYTE
        try:
            with wrap_os_errors(part.target):
                if start == 0:
                    part.begin(remote)
                with (
                    part.path.open("ab") as file,
                    progress_bar(label, whole, "MB", quiet=quiet, done=done) as bar,
                ):
                    for chunk in _chunks(response):
                        file.write(chunk)
                        file.flush()  # what has arrived survives a kill
                        bar.advance(len(chunk) / _MEGABYTE)
                    os.fsync(file.fileno())
        except InputError:
            part.discard()
            raise
    if remote.length is not None and part.size() != remote.length:
        raise _PassingFault(
            f"found {part.size():,} bytes of {remote.length:,}, then the end of the connection"
        )


def _remote(url: str, headers: Mapping[str, str]) -> _Remote:
    """Read a server's description of the whole file, from a full or a partial response."""
    length = headers.get("Content-Range", headers.get("Content-Length", "")).rpartition("/")[2]
    etag = headers.get("ETag", "W/")
    validator = headers.get("Last-Modified") if etag.startswith("W/") else etag
    return _Remote(url, int(length) if length.isdecimal() else None, validator)


def _open(url: str, headers: dict[str, str], part: _Part) -> Any:
    """Open an address, and classify its errors.

    Raises:
        _PassingFault: the same request may succeed, or one for the whole file.
        InputError: it will not succeed.
    """
    # A new opener reads the environment's current proxies.
    opener = urllib.request.build_opener()
    try:
        return opener.open(urllib.request.Request(url, headers=headers), timeout=_TIMEOUT)
    except urllib.error.HTTPError as error:
        error.close()
        said = f"HTTP {error.code} {error.reason}"
        if error.code == _NO_SUCH_RANGE:  # the file is shorter than its beginning here
            part.discard()
        if error.code in _PASSING:
            raise _PassingFault(f"found {said}") from error
        kind = MissingFileError if error.code in _GONE else InputError
        raise kind(f"{url}: found {said}, expected the file") from error
    except (OSError, http.client.HTTPException) as error:
        if url.startswith("file:"):
            raise MissingFileError(f"{url}: found no such file, expected one") from error
        reason = _reason(getattr(error, "reason", error))
        raise _PassingFault(f"found no answer ({reason})") from error


def _chunks(response: Any) -> Iterator[bytes]:
    """Yield the parts of a response as they arrive.

    Raises:
        _PassingFault: the connection breaks or stalls.
    """
    try:
        while chunk := response.read1(_CHUNK):
            yield chunk
    except (OSError, http.client.HTTPException) as error:
        raise _PassingFault(f"found a broken connection ({_reason(error)})") from error


def _reason(error: object) -> str:
    """Return an error's reason in a few words."""
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
