"""Download a file: tried again after a fault, resumed after a cut, and never half a file."""

import contextlib
import dataclasses
import http.client
import itertools
import os
import pathlib
import re
import shutil
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Iterable, Iterator, Mapping
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
class Patience:
    """How long a download bears with a server."""

    timeout: float = 30.0
    """Seconds without an answer, or with less than `least` bytes, before a server is given up."""
    least: int = 2**14
    """Bytes that have to arrive in that time."""
    attempts: int = 5
    """Attempts in a row that bring less than `progress` bytes."""
    progress: int = 2**20
    """Bytes that an attempt has to bring for the count to begin anew."""
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
    patience: Patience | None = None,
) -> None:
    """Download a file to `target`, which appears when it is whole.

    The beginning of an unfinished file stays beside it, as `target`.part, with what the server
    says of it. The next call goes on from there if the server still has the same file: the same
    length, and the same ETag or time of change. A server that names neither starts again.

    Proxies are those of the environment: `http_proxy`, `https_proxy`, `no_proxy`.

    Args:
        url: the address, of http, https or file.
        target: the file, in a folder that is there and that no other process writes to.
        label: what stands beside the progress bar.
        quiet: no progress bar.
        patience: how long to bear with the server; None is the default.

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
    patience = patience or Patience()
    transfer = _Transfer(url, target, label, quiet, patience)
    failures = 0
    while True:
        before = transfer.size()
        try:
            transfer.attempt()
            break
        except _PassingFault as fault:
            failures = 1 if transfer.size() - before >= patience.progress else failures + 1
            if failures >= patience.attempts:
                raise InputError(
                    f"{url}: {fault}, expected the whole file (attempts: {failures}; the same "
                    "command goes on from there)"
                ) from fault
            time.sleep(patience.pause * 2 ** (failures - 1))
    transfer.finish()


@dataclasses.dataclass(frozen=True)
class _Remote:
    """What a server says of a file, by which its beginning is known again."""

    url: str
    length: int | None
    etag: str | None
    """Only a strong one: weak tags are of equal meanings, and not of equal bytes."""
    modified: str | None

    def is_recognisable(self) -> bool:
        """Return whether another file at the same address would be noticed."""
        return self.length is not None and (self.etag, self.modified) != (None, None)

    def may_be(self, begun: "_Remote") -> bool:
        """Return whether a part of this file goes on with one; parts need not tell the time."""
        same = (self.length, self.etag) == (begun.length, begun.etag)
        return same and self.modified in (None, begun.modified)


class _Transfer:
    """The download of one file, over several attempts."""

    def __init__(
        self, url: str, target: pathlib.Path, label: str, quiet: bool, patience: Patience
    ) -> None:
        self._url, self._target, self._label = url, target, label
        self._quiet, self._patience = quiet, patience
        self._part = target.with_name(f"{target.name}.part")
        self._note = target.with_name(f"{target.name}.part.json")

    def size(self) -> int:
        """Return the size of the unfinished file."""
        return self._part.stat().st_size if self._part.is_file() else 0

    def _discard(self) -> None:
        """Remove the unfinished file."""
        self._part.unlink(missing_ok=True)
        self._note.unlink(missing_ok=True)

    def finish(self) -> None:
        """Give the whole file its name."""
        with wrap_os_errors(self._target):
            os.replace(self._part, self._target)
            self._note.unlink(missing_ok=True)

    def attempt(self) -> None:
        """Fetch what is missing.

        Raises:
            _PassingFault: it did not all arrive.
            InputError: what `download` raises.
        """
        begun = self._begun()
        if begun is not None and self.size() == begun.length:
            return
        try:
            self._fetch(begun)
        except _OtherFile:
            self._fetch(None)

    def _begun(self) -> _Remote | None:
        """Return whose beginning the unfinished file is; None where it cannot be gone on with."""
        if not self.size():
            return None
        try:
            begun = _Remote(**read_json(self._note, "a note of a download"))
        except (InputError, TypeError):
            return None
        fits = begun.length is not None and self.size() <= begun.length
        return begun if begun.url == self._url and begun.is_recognisable() and fits else None

    def _fetch(self, begun: _Remote | None) -> None:
        """Fetch the file, or what is missing after its beginning."""
        start = 0 if begun is None else self.size()
        headers = {"User-Agent": f"crisalad-jax/{VERSION}", "Accept-Encoding": "identity"}
        if begun is not None:
            headers |= {"Range": f"bytes={start}-", "If-Range": begun.etag or begun.modified or ""}
        with _opened(self._url, headers, self._patience.timeout) as response:
            remote = _remote(self._url, response)
            if getattr(response, "status", None) == 206:
                if begun is None or _first_byte(response) != start or not remote.may_be(begun):
                    raise _OtherFile
                self._receive(response, begun, start)
            else:  # the whole file, whether or not its beginning is here
                self._receive(response, remote, 0)

    def _receive(self, response: Any, remote: _Remote, start: int) -> None:
        """Write what arrives behind the first `start` bytes."""
        missing = None if remote.length is None else remote.length - start
        chunks = _chunks(response, self._patience)
        first = next(chunks, b"")
        if start == 0:
            self._check_no_page(response, first)
        free = shutil.disk_usage(self._target.parent).free
        if missing is not None and missing > free:
            raise InputError(
                f"{self._target}: found {free:,} bytes free on the disk, expected {missing:,}"
            )
        try:
            with wrap_os_errors(self._target):
                if start == 0:
                    self._discard()  # first: a note is of the bytes beside it
                    write_json(self._note, dataclasses.asdict(remote))
                self._write(itertools.chain((first,), chunks), remote, start)
        except InputError:
            self._discard()
            raise
        if remote.length is not None and self.size() != remote.length:
            raise _PassingFault(
                f"found {self.size():,} bytes of {remote.length:,}, then the end of the connection"
            )

    def _write(self, chunks: Iterable[bytes], remote: _Remote, start: int) -> None:
        """Append chunks to the unfinished file, with a progress bar."""
        whole, done = (remote.length or 0) / _MEGABYTE, start / _MEGABYTE
        with (
            self._part.open("ab") as file,
            progress_bar(self._label, whole, "MB", quiet=self._quiet, done=done) as bar,
        ):
            for chunk in chunks:
                file.write(chunk)
                file.flush()  # what has arrived outlives a kill
                bar.advance(len(chunk) / _MEGABYTE)
            os.fsync(file.fileno())

    def _check_no_page(self, response: Any, first: bytes) -> None:
        """Raise InputError where a page of HTML comes in place of the file."""
        kind = response.headers.get_content_type()
        if kind == "text/html" or is_html(first):
            raise InputError(
                f"{self._url}: found a page of HTML, expected the file {self._target.name} (some "
                "hosts send one after too many downloads, or where a file was removed)"
            )


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


def _first_byte(response: Any) -> int | None:
    """Return where a partial answer begins."""
    match = re.fullmatch(r"bytes (\d+)-\d+/.*", response.headers.get("Content-Range", ""))
    return None if match is None else int(match[1])


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


def _chunks(response: Any, patience: Patience) -> Iterator[bytes]:
    """Yield what arrives, until it ends.

    Raises:
        _PassingFault: the connection breaks, stalls, or is slower than `patience` bears.
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
        if now - since > patience.timeout:
            if arrived < patience.least:
                raise _PassingFault(f"found {arrived} bytes in {now - since:.0f} s")
            since, arrived = now, 0


def _reason(error: object) -> str:
    """Return an error's reason in a few words."""
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
