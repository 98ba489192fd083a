"""Who may ask, and what is refused before anything is opened."""

import pytest

from crisalad_jax.cli import main
from crisalad_jax.retrieval.serve import serve_map
from crisalad_jax.retrieval.serve.server import is_loopback
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
def test_what_other_machines_can_reach_needs_a_token(host, own):
    assert is_loopback(host) is own
    words = "no.map: found no map" if own else "other machines can reach, and no token"
    with pytest.raises(InputError, match=words):
        serve_map("no.map", host=host, port=0)


def test_where_a_token_comes_from(tmp_path, monkeypatch):
    given = []
    monkeypatch.setattr(
        "crisalad_jax.cli.serve.serve_map", lambda *_, token, **__: given.append(token)
    )
    command = ["serve", "--map", "no.map"]
    monkeypatch.delenv("CRISALAD_TOKEN", raising=False)
    assert main(command) == 0
    monkeypatch.setenv("CRISALAD_TOKEN", "a" * 16)
    assert main(command) == 0
    (tmp_path / "token").write_text(f"{TOKEN}\n")
    assert main([*command, "--token-file", str(tmp_path / "token")]) == 0  # the flag wins
    assert given == [None, "a" * 16, TOKEN]


@pytest.mark.parametrize("token", ["", "short", f"{TOKEN} {TOKEN}", f"{TOKEN}é"])
def test_a_token_that_is_easy_to_guess(token):
    with pytest.raises(InputError, match=f"token: found {len(token)} characters"):
        serve_map("no.map", token=token)


def test_the_command_refuses_in_one_line(capfd, monkeypatch):
    monkeypatch.delenv("CRISALAD_TOKEN", raising=False)
    for given, words in (
        (["--host", "0.0.0.0"], "crisalad: host: found '0.0.0.0', which other machines can reach"),
        (["--k", "0"], "crisalad: k: found 0, expected 1 to 100"),
        (["--port", "65536"], "crisalad: port: found 65536"),
        (["--max-bytes", "0"], "crisalad: max_bytes: found 0"),
        (["--batch-size", "0"], "crisalad: batch size: found 0"),
        (["--map-images", "none"], "crisalad: map_images: found no folder none"),
        (["--token-file", "none"], "crisalad: none: "),
        (["--host", "256.1"], "crisalad: host: found '256.1', which other"),
        (["--port", "0"], "crisalad: no.map: found no map, expected a folder"),
    ):
        assert main(["serve", "--map", "no.map", *given]) == 2
        err = capfd.readouterr().err
        assert err.startswith(words), err
        assert err.count("\n") == 1
    monkeypatch.setenv("CRISALAD_TOKEN", TOKEN)
    assert main(["serve", "--map", "no.map", "--host", "no.such.name.invalid"]) == 2
    assert capfd.readouterr().err.startswith(
        "crisalad: host and port: cannot listen at no.such.name.invalid:8000: "
    )
