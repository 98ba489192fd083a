"""Download a file: tried again after a fault, resumed after a cut, and never half a file."""

import contextlib
import dataclasses
import http.client
import itertools
import os
import pathlib
import shutil
import ssl
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


@dataclasses.dataclass(frozen=True)
class RetryPolicy:
    """Timeouts and retries of a download."""

    timeout: float = 30.0
    """Seconds without an answer, or with less than `least` bytes, before a server is given up."""
    least: int = 2**14
    """Bytes that have to arrive in that time."""
    attempts: int = 5
    """Attempts in a row that bring less than `progress` bytes."""
    progress: int = 2**20
    """Bytes that an attempt has to bring for the count to begin again."""
    pause: float = 1.0
    """Seconds before the second attempt; each further one waits twice as long."""


class MissingFileError(InputError):
    """There is no file at an address."""


class _PassingFault(Exception):
    """A fault after which the same request may succeed."""


class _OtherFile(Exception):
    """What is at an address is not the file whose beginning is here."""


def download(
    url: str,
    target: pathlib.Path,
    *,
    label: str,
    quiet: bool = False,
    policy: RetryPolicy | None = None,
) -> None:
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
        policy: timeouts and retries; None is the default.

    Raises:
        MissingFileError: there is no such file.
        InputError: the server refuses, stalls or fails in every attempt, or sends a page of HTML;
            or the disk is full. Only then the unfinished file does not stay.

    Example:
        >>> _ = (folder / "there.txt").write_text("all of it")
        >>> target = folder / "here.txt"
        >>> download((folder / "there.txt").as_uri(), target, label="text", quiet=True)
        >>> target.read_text()
        'all of it'
    """
    policy = policy or RetryPolicy()
    part = _Part(target)
    failures = 0
    while True:
        before = part.size()
        begun = part.begun(url)
        try:
            try:
                _fetch(url, part, begun, label, quiet, policy)
            except _OtherFile:
                _fetch(url, part, None, label, quiet, policy)
            break
        except _PassingFault as fault:
            failures = 1 if part.size() - before >= policy.progress else failures + 1
            if failures >= policy.attempts:
                raise InputError(
                    f"{url}: {fault}, expected the whole file (attempts: {failures}; the same "
                    "command goes on from there)"
                ) from fault
            time.sleep(policy.pause * 2 ** (failures - 1))
    with wrap_os_errors(target):
        os.replace(part.path, target)
        part.note.unlink(missing_ok=True)


@dataclasses.dataclass(frozen=True)
class _Remote:
    """What a server says of a file, by which its beginning is known again."""

    url: str
    length: int | None
    etag: str | None
    """Only a strong one: weak tags are of equal meanings, and not of equal bytes."""
    modified: str | None


class _Part:
    """An unfinished file, and the note of whose beginning it is."""

    def __init__(self, target: pathlib.Path) -> None:
        self.target = target
        self.path = target.with_name(f"{target.name}.part")
        self.note = target.with_name(f"{target.name}.part.json")

    def size(self) -> int:
        return self.path.stat().st_size if self.path.is_file() else 0

    def discard(self) -> None:
        self.path.unlink(missing_ok=True)
        self.note.unlink(missing_ok=True)

    def begun(self, url: str) -> _Remote | None:
        """Return whose beginning this is; None where another file would not be noticed."""
        try:
            begun = _Remote(**read_json(self.note, "a note of a download"))
        except (InputError, TypeError):
            return None
        if begun.url != url or begun.length is None or (begun.etag, begun.modified) == (None, None):
            return None
        return begun if 0 < self.size() <= begun.length else None


def _fetch(
    url: str, part: _Part, begun: _Remote | None, label: str, quiet: bool, policy: RetryPolicy
) -> None:
    """Fetch the file, or what is missing after its beginning.

    Raises:
        _PassingFault: it did not all arrive.
        _OtherFile: the server has another file than `begun`.
        InputError: what `download` raises.
    """
    start = 0 if begun is None else part.size()
    if begun is not None and start == begun.length:
        return
    headers = {"User-Agent": f"crisalad-jax/{VERSION}", "Accept-Encoding": "identity"}
    if begun is not None:
        headers |= {"Range": f"bytes={start}-", "If-Range": begun.etag or begun.modified or ""}
    with _opened(url, headers, policy.timeout) as response:
        remote = _remote(url, response)
        if getattr(response, "status", None) != 206:
            start = 0  # the whole file, whether or not its beginning is here
        elif begun is None or not _continues(response, remote, begun, start):
            raise _OtherFile
        chunks = _chunks(response, policy)
        first = next(chunks, b"")
        is_page = response.headers.get_content_type() == "text/html" or is_html(first)
        if start == 0 and is_page:
            raise InputError(
                f"{url}: found a page of HTML, expected the file {part.target.name} (some hosts "
                "send one after too many downloads, or where a file was removed)"
            )
        missing = (remote.length or start) - start
        if missing > (free := shutil.disk_usage(part.target.parent).free):
            raise InputError(
                f"{part.target}: found {free:,} bytes free on the disk, expected {missing:,}"
            )
        try:
            with wrap_os_errors(part.target):
                if start == 0:
                    part.discard()  # first: a note is of the bytes next to it
                    write_json(part.note, dataclasses.asdict(remote))
                whole, done = (remote.length or 0) / _MEGABYTE, start / _MEGABYTE
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


def _continues(response: Any, remote: _Remote, begun: _Remote, start: int) -> bool:
    """Return whether a partial answer goes on with a file; it need not tell the time of change."""
    spans = response.headers.get("Content-Range", "").startswith(f"bytes {start}-")
    same = (remote.length, remote.etag) == (begun.length, begun.etag)
    return spans and same and remote.modified in (None, begun.modified)


def _remote(url: str, response: Any) -> _Remote:
    """Read what a server says of the whole file."""
    headers: Mapping[str, str] = response.headers
    length = headers.get("Content-Length")
    if getattr(response, "status", None) == 206:
        length = headers.get("Content-Range", "").rpartition("/")[2]
    known = length is not None and length.isdecimal()
    etag = headers.get("ETag")
    return _Remote(
        url,
        int(length or 0) if known else None,
        None if etag is None or etag.startswith("W/") else etag,
        headers.get("Last-Modified"),
    )


@contextlib.contextmanager
def _opened(url: str, headers: Mapping[str, str], timeout: float) -> Iterator[Any]:
    """Open an address, and sort what may go wrong there.

    Raises:
        _PassingFault: the same request may succeed.
        _OtherFile: the file is shorter than its beginning here.
        InputError: it will not succeed.
    """
    with contextlib.ExitStack() as stack:
        try:
            request = urllib.request.Request(url, headers=dict(headers))
            opener = urllib.request.build_opener()  # anew, for the environment's proxies of today
            response = stack.enter_context(opener.open(request, timeout=timeout))
        except urllib.error.HTTPError as error:
            error.close()
            said = f"HTTP {error.code} {error.reason}"
            if error.code in _PASSING:
                raise _PassingFault(f"found {said}") from error
            if error.code == 416 and "Range" in headers:
                raise _OtherFile from error
            kind = MissingFileError if error.code in _GONE else InputError
            raise kind(f"{url}: found {said}, expected the file") from error
        except urllib.error.URLError as error:
            if url.startswith("file:"):
                raise MissingFileError(f"{url}: found no such file, expected one") from error
            if isinstance(error.reason, ssl.SSLCertVerificationError):
                raise InputError(f"{url}: found a certificate that does not hold") from error
            raise _PassingFault(f"found no answer ({_reason(error.reason)})") from error
        except (OSError, http.client.HTTPException) as error:
            raise _PassingFault(f"found no answer ({_reason(error)})") from error
        except ValueError as error:
            raise InputError(f"{url}: found no address ({error}), expected one") from error
        yield response


def _chunks(response: Any, policy: RetryPolicy) -> Iterator[bytes]:
    """Yield what arrives, until it ends.

    Raises:
        _PassingFault: the connection breaks, stalls, or is slower than the policy allows.
    """
    since, arrived = time.monotonic(), 0
    while True:
        try:
            chunk = response.read1(_CHUNK)
        except (OSError, http.client.HTTPException) as error:
            raise _PassingFault(f"found a broken connection ({_reason(error)})") from error
        if not chunk:
            return
        arrived += len(chunk)
        yield chunk
        now = time.monotonic()
        if now - since > policy.timeout:
            if arrived < policy.least:
                raise _PassingFault(f"found {arrived} bytes in {now - since:.0f} s")
            since, arrived = now, 0


def _reason(error: object) -> str:
    """Return an error's reason in a few words."""
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
