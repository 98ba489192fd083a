"""Download a file: tried again after a fault, resumed after a cut, and never half a file."""

import dataclasses
import http.client
import itertools
import os
import pathlib
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from typing import Any

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import is_html, read_json, wrap_os_errors, write_json
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.version import VERSION

_CHUNK = 2**18
_MEGABYTE = 1e6
_PASSING = (408, 425, 429, 500, 502, 503, 504)
"""Codes of HTTP after which the same request may succeed."""
_GONE = (404, 410)
_PARTIAL, _NO_SUCH_RANGE = 206, 416
_TIMEOUT = 30.0
"""Seconds without an answer before a server is given up."""
_ATTEMPTS = 5
"""Attempts in a row that bring less than a megabyte."""
_PAUSE = 1.0
"""Seconds before the second attempt; each further one waits twice as long."""


class MissingFileError(InputError):
    """No file exists at an address."""


class _PassingFault(Exception):
    """A fault after which the same request may succeed."""


class _OtherFile(Exception):
    """What is at an address is not the file whose beginning is here."""


def download(url: str, target: pathlib.Path, *, label: str, quiet: bool = False) -> None:
    """Download a file to `target`, which appears when it is whole.

    The beginning of an unfinished file stays next to it, as `target`.part, with what the server
    says of it. The next call resumes from there if the server still has the same file: the same
    length, and the same ETag or time of change. A server that names neither starts again.

    Proxies are those of the environment: `http_proxy`, `https_proxy`, `no_proxy`.

    Args:
        url: the address, of http, https or file.
        target: the file, in a folder that is there and that no other process writes to.
        label: what is written in front of the progress bar.
        quiet: no progress bar.

    Raises:
        MissingFileError: the file does not exist.
        InputError: the server refuses, stalls or fails in every attempt, or sends a page of HTML;
            or the disk is full. Only then the unfinished file does not stay.

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
        except _OtherFile:
            part.discard()
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
    """What a server says of a file, by which its beginning is known again."""

    url: str
    length: int | None
    validator: str | None
    """Its strong ETag (equal weak ones may be of unequal bytes), else its time of change."""


class _Part:
    """An unfinished file, and the note of whose beginning it is."""

    def __init__(self, target: pathlib.Path) -> None:
        self.target = target
        self.path = target.with_name(f"{target.name}.part")
        self._note = target.with_name(f"{target.name}.part.json")

    def size(self) -> int:
        return self.path.stat().st_size if self.path.is_file() else 0

    def begin(self, remote: _Remote) -> None:
        self.discard()  # first: a note is of the bytes next to it
        write_json(self._note, dataclasses.asdict(remote))

    def discard(self) -> None:
        self.path.unlink(missing_ok=True)
        self._note.unlink(missing_ok=True)

    def begun(self, url: str) -> _Remote | None:
        """Return whose beginning this is; None where another file would not be noticed."""
        try:
            begun = _Remote(**read_json(self._note, "a note of a download"))
        except InputError:
            return None
        known = begun.url == url and begun.validator
        return begun if known and 0 < self.size() <= (begun.length or 0) else None


def _fetch(url: str, part: _Part, label: str, quiet: bool) -> None:
    """Fetch the file, or what is missing after its beginning.

    Raises:
        _PassingFault: it did not all arrive.
        _OtherFile: the server has another file than the one that was begun.
        InputError: what `download` raises.
    """
    begun = part.begun(url)
    start = part.size() if begun else 0
    if begun and start == begun.length:
        return
    headers = {"User-Agent": f"crisalad-jax/{VERSION}", "Accept-Encoding": "identity"}
    if begun:
        headers |= {"Range": f"bytes={start}-", "If-Range": str(begun.validator)}
    with _open(url, headers) as response:
        if begun and response.status == _PARTIAL:
            _check_continues(response.headers, begun, start)
            remote = begun
        else:  # the whole file, whether or not its beginning is here
            start, remote = 0, _remote(url, response.headers)
        chunks = _chunks(response)
        first = next(chunks, b"")
        is_page = response.headers.get_content_type() == "text/html" or is_html(first)
        if start == 0 and is_page:
            raise InputError(
                f"{url}: found a page of HTML, expected the file {part.target.name} (some hosts "
                "send one after too many downloads, or where a file was removed)"
            )
        whole, done = (remote.length or 0) / _MEGABYTE, start / _MEGABYTE
        try:
            with wrap_os_errors(part.target):
                if start == 0:
                    part.begin(remote)
                with (
                    part.path.open("ab") as file,
                    progress_bar(label, whole, "MB", quiet=quiet, done=done) as bar,
                ):
                    for chunk in itertools.chain((first,), chunks):
                        file.write(chunk)
                        file.flush()  # what has arrived outlives a kill
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
    """Read what a server says of the whole file."""
    length, etag = headers.get("Content-Length", ""), headers.get("ETag", "W/")
    validator = headers.get("Last-Modified") if etag.startswith("W/") else etag
    return _Remote(url, int(length) if length.isdecimal() else None, validator)


def _check_continues(headers: Mapping[str, str], begun: _Remote, start: int) -> None:
    """Check that a partial answer resumes the file that was begun.

    Raises:
        _OtherFile: it does not.
    """
    span = headers.get("Content-Range", "")
    same = span.startswith(f"bytes {start}-") and span.endswith(f"/{begun.length}")
    # An answer to `If-Range` need not repeat the time of change.
    if not same or _remote(begun.url, headers).validator not in (None, begun.validator):
        raise _OtherFile


def _open(url: str, headers: dict[str, str]) -> Any:
    """Open an address, and sort what may go wrong there.

    Raises:
        _PassingFault: the same request may succeed.
        _OtherFile: the file is shorter than its beginning here.
        InputError: it will not succeed.
    """
    # A new opener reads the environment's proxies of today.
    opener = urllib.request.build_opener()
    try:
        return opener.open(urllib.request.Request(url, headers=headers), timeout=_TIMEOUT)
    except urllib.error.HTTPError as error:
        error.close()
        said = f"HTTP {error.code} {error.reason}"
        if error.code in _PASSING:
            raise _PassingFault(f"found {said}") from error
        if error.code == _NO_SUCH_RANGE and "Range" in headers:
            raise _OtherFile from error
        kind = MissingFileError if error.code in _GONE else InputError
        raise kind(f"{url}: found {said}, expected the file") from error
    except (OSError, http.client.HTTPException) as error:
        if url.startswith("file:"):
            raise MissingFileError(f"{url}: found no such file, expected one") from error
        reason = _reason(getattr(error, "reason", error))
        raise _PassingFault(f"found no answer ({reason})") from error


def _chunks(response: Any) -> Iterator[bytes]:
    """Yield what arrives, until it ends.

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
