"""Who may ask, and what is refused before anything is opened."""

import pytest

from crisalad_jax.cli import main
from crisalad_jax.serve.access import Access, RefusedError, check_host, is_loopback, read_token
from crisalad_jax.utils.errors import InputError

TOKEN = "0123456789abcdef"


@pytest.mark.parametrize(
    ("host", "own"),
    [
        ("localhost", True),
        ("127.0.0.1", True),
        ("127.8.8.8", True),
        ("::1", True),
        ("0.0.0.0", False),
        ("::", False),
        ("", False),
        ("192.168.1.4", False),
        ("localhost.evil.example", False),
        ("example.org", False),
    ],
)
def test_what_is_this_machine(host, own):
    assert is_loopback(host) is own
    if own:
        check_host(host, None)
    else:
        with pytest.raises(InputError, match="other machines can reach, and no token"):
            check_host(host, None)
    check_host(host, TOKEN)


@pytest.mark.parametrize("host", ["localhost:8000", "127.0.0.1", "[::1]:8000", "LOCALHOST"])
def test_hosts_that_are_answered(host):
    Access(None).check("GET", "/map", {"host": host})
    Access(None).check("POST", "/locate", {"host": host, "origin": f"http://{host}"})


@pytest.mark.parametrize("host", ["", "[", "evil.example", "127.0.0.1.evil.example", "a@[::1"])
def test_hosts_that_are_not(host):
    with pytest.raises(RefusedError) as refused:
        Access(None).check("GET", "/", {"host": host})
    assert refused.value.status == 421


@pytest.mark.parametrize("origin", ["null", "https://localhost:8000", "http://localhost:9000"])
def test_pages_of_other_sites(origin):
    with pytest.raises(RefusedError) as refused:
        Access(None).check("POST", "/images", {"host": "localhost:8000", "origin": origin})
    assert refused.value.status == 403


def test_where_a_token_comes_from(tmp_path, monkeypatch):
    monkeypatch.delenv("CRISALAD_TOKEN", raising=False)
    assert read_token(None) is None
    monkeypatch.setenv("CRISALAD_TOKEN", "a" * 16)
    assert read_token(None) == "a" * 16
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n")
    assert read_token(file) == TOKEN  # the flag wins
    for text in ("", "short", f"{TOKEN} {TOKEN}", f"{TOKEN}é"):
        file.write_text(text)
        with pytest.raises(InputError, match=rf"{file}: found a token of {len(text)} letters"):
            read_token(file)


def test_the_command_refuses_in_one_line(capfd, monkeypatch, tmp_path):
    monkeypatch.delenv("CRISALAD_TOKEN", raising=False)
    for given, words in (
        (["--host", "0.0.0.0"], "crisalad: host: found '0.0.0.0', which other machines can reach"),
        (["--k", "0"], "crisalad: k: found 0, expected 1 to 100"),
        (["--port", "65536"], "crisalad: port: found 65536"),
        (["--max-bytes", "0"], "crisalad: max_bytes: found 0"),
        (["--batch-size", "0"], "crisalad: batch size: found 0"),
        (["--map-images", "none"], "crisalad: map_images: found no folder none"),
        (["--token-file", "none"], "crisalad: none: "),
        (["--host", "no.such.name.invalid"], "crisalad: host: found 'no.such.name.invalid'"),
        (["--port", "0"], "crisalad: no.map: found no map, expected a folder"),
    ):
        assert main(["serve", "--map", "no.map", *given]) == 2
        err = capfd.readouterr().err
        assert err.startswith(words), err
        assert err.count("\n") == 1
