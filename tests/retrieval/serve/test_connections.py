"""Clients that keep the service waiting, and what is not HTTP."""

import contextlib
import json
import socket
import time

import pytest

from crisalad_jax.retrieval.serve import server

HEAD = b"GET /health HTTP/1.1\r\nHost: 127.0.0.1\r\n"
HALVES = {
    "nothing": b"",
    "half a head": HEAD,
    "half a body": b"POST /locate HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99\r\n\r\nhalf",
    "unread answers": 200 * (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"),
}


def opened(port: int, data: bytes) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), timeout=60)
    connection.sendall(data)
    return connection


def wait_for_end(connection: socket.socket) -> None:
    """Return when the service has closed a connection."""
    with contextlib.suppress(ConnectionError):
        while connection.recv(2**16):
            pass


@pytest.mark.parametrize("half", list(HALVES)[:3])  # the last is answered for a while
def test_more_connections_than_there_may_be(service, half, monkeypatch):
    """The oldest that keep the service waiting are closed, and every question is answered."""
    monkeypatch.setattr(server, "most_files", lambda: 5)
    monkeypatch.setattr(server, "warn", (said := []).append)
    with contextlib.ExitStack() as stack:
        held = []
        for _ in range(5):
            held.append(stack.enter_context(opened(service.port, HALVES[half])))
            assert service.ask("GET", "/health").status == 200
        for oldest in held[:3]:
            wait_for_end(oldest)
        held[-1].setblocking(False)
        with pytest.raises(BlockingIOError):
            held[-1].recv(1)
    assert said[0] == "found more than 2 connections at once: closing those that wait longest"


@pytest.mark.parametrize("half", HALVES)
def test_a_client_that_is_too_slow(service, half, monkeypatch):
    monkeypatch.setattr(server, "_HEAD", 0.5)
    monkeypatch.setattr(server, "_EXCHANGE", 0.5)
    with opened(service.port, HALVES[half]) as held:
        with contextlib.suppress(ConnectionError):
            while half == "half a head":  # letter by letter: it is the whole head that counts
                held.sendall(b"A")
                time.sleep(0.1)
        wait_for_end(held)


def test_a_body_behind_its_answer_ends_too(service, monkeypatch):
    """Of a request that is refused before its body is here."""
    monkeypatch.setattr(server, "_HEAD", 0.5)
    head = b"POST /none HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9999\r\n\r\n"
    with opened(service.port, head) as held:
        assert held.recv(2**16).startswith(b"HTTP/1.1 404 ")
        with contextlib.suppress(ConnectionError):
            while held.send(b"a"):
                time.sleep(0.05)


def test_an_answer_takes_as_long_as_it_does(service, pictures, monkeypatch):
    monkeypatch.setattr(server, "_HEAD", 0.2)
    monkeypatch.setattr(server, "_EXCHANGE", 0.2)
    search = service.worker.places.search

    def slow(*given, **options):
        time.sleep(1)
        return search(*given, **options)

    monkeypatch.setattr(service.worker.places, "search", slow)
    assert service.ask("POST", "/locate", pictures[0].read_bytes()).status == 200


@pytest.mark.parametrize(
    "data",
    [
        b"hello\r\n\r\n",
        b"GET / HTTP/1.1\r\n\r\n",  # no Host
        HEAD + b"Host: localhost\r\n\r\n",
        HEAD + b"A: " + bytes(70_000),
        b"POST /locate HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\nx\r\n",
        # The route answers at once, and the end of the body is wrong.
        b"POST /none HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n1\r\na\r\nx\r\n",
    ],
)
def test_what_is_not_http_is_answered_as_all_else(service, data, capfd):
    with opened(service.port, data) as connection, contextlib.suppress(ConnectionError):
        answer = b""
        while more := connection.recv(2**16):
            answer += more
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 400 ")
    assert b"\r\ncontent-type: application/json" in head
    assert b"\r\nx-content-type-options: nosniff" in head
    assert set(json.loads(body)) == {"error"}
    assert capfd.readouterr().err == ""
