"""Who may ask: a token, or a program and a page on this machine."""

import dataclasses
import ipaddress
import os
import secrets
import urllib.parse
from collections.abc import Mapping

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_text

TOKEN_VARIABLE = "CRISALAD_TOKEN"
_SHORTEST = 16
OPEN_PATHS = frozenset({"/", "/health", "/openapi.json"})
"""Paths that need no token: they tell nothing of places."""


class RefusedError(Exception):
    """A request that is not answered, with its status and one line that says why."""

    def __init__(self, status: int, reason: str, headers: Mapping[str, str] | None = None) -> None:
        """Take the status, the line, and headers of the answer."""
        super().__init__(reason)
        self.status, self.headers = status, dict(headers or {})


def read_token(file: str | os.PathLike[str] | None) -> str | None:
    """Read the token that requests must bring, of a file or of the variable `CRISALAD_TOKEN`.

    Raises:
        InputError: the file cannot be read, or the token is short or has spaces in it.
    """
    if file is not None:
        source, text = str(file), read_text(file, "a token in one line")
    else:
        source, text = TOKEN_VARIABLE, os.environ.get(TOKEN_VARIABLE)
        if text is None:
            return None
    return check_token(text.strip(), source)


def check_token(token: str, source: str = "token") -> str:
    """Return a token, which has to be hard to guess and to fit into a header.

    Raises:
        InputError: it does not.
    """
    if len(token) < _SHORTEST or not all("!" <= letter <= "~" for letter in token):
        raise InputError(
            f"{source}: found a token of {len(token)} letters, expected at least {_SHORTEST} of "
            "ASCII without spaces, as of `openssl rand -hex 16`"
        )
    return token


def is_loopback(host: str) -> bool:
    """Return whether a name or an address is this machine's own, which no other can reach."""
    if host.rstrip(".").lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_host(host: str, token: str | None) -> None:
    """Check that what other machines can reach has a token.

    Raises:
        InputError: it has none.
    """
    if token is None and not is_loopback(host):
        raise InputError(
            f"host: found {host!r}, which other machines can reach, and no token, expected "
            f"--token-file or {TOKEN_VARIABLE}, or --host 127.0.0.1"
        )


@dataclasses.dataclass(frozen=True)
class Access:
    """The rule: with a token whoever brings it, without one only this machine.

    A page of another site can send requests to this machine, too, but it sends its own name as
    `Origin`; a name that was bound to this machine's address (DNS rebinding) shows in `Host`.
    """

    token: str | None

    def check(self, method: str, path: str, headers: Mapping[str, str]) -> None:
        """Check a request by its headers, whose names are in lower case.

        Raises:
            RefusedError: it may not be answered.
        """
        if self.token is not None:
            kind, _, given = headers.get("authorization", "").partition(" ")
            if path in OPEN_PATHS or (
                kind.lower() == "bearer"
                and secrets.compare_digest(given.strip().encode(), self.token.encode())
            ):
                return
            raise RefusedError(
                401,
                "Authorization: expected 'Bearer' and the token of this service",
                {"WWW-Authenticate": "Bearer"},
            )
        host = headers.get("host", "")
        if not is_loopback(_name_of(host)):
            raise RefusedError(
                421, f"Host: found {host!r}, expected this machine's; another needs a token"
            )
        origin = headers.get("origin")
        if method not in ("GET", "HEAD") and origin not in (None, f"http://{host}"):
            raise RefusedError(403, f"Origin: found {origin!r}, expected this service's own page")


def _name_of(host: str) -> str:
    """Return the host of `host:port`; nothing where that cannot be read."""
    try:
        return urllib.parse.urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""
