"""Files at the hubs, through huggingface_hub's own client and a server of the tests."""

import pathlib
import re
import sys
from collections.abc import Iterator

import huggingface_hub.constants
import pytest

from crisalad_jax.utils.download import OFFLINE
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.hub import (
    HubAddress,
    download_file,
    download_kaggle,
    parse_hub,
    upload_folder,
)
from tests.hub_server import COMMIT, Hub, hub_server

TOKEN = "hf_thisisasecretofthetests"


@pytest.fixture
def hub(tmp_path, monkeypatch) -> Iterator[Hub]:
    monkeypatch.delenv(OFFLINE, raising=False)
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    with hub_server(monkeypatch) as hub:
        yield hub


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("hf://a/b", HubAddress("a/b")),
        (pathlib.Path("hf://a/b"), HubAddress("a/b")),
        ("hf://a/b/", HubAddress("a/b")),
        ("hf://a-1/b.c_d@v1.0", HubAddress("a-1/b.c_d", "v1.0")),
        ("hf://a/b/folder/w.safetensors", HubAddress("a/b", None, "folder/w.safetensors")),
        ("hf://a/b@main/w.safetensors", HubAddress("a/b", "main", "w.safetensors")),
    ],
)
def test_addresses(text, expected):
    assert parse_hub(text) == expected
    assert parse_hub(str(expected)) == expected


@pytest.mark.parametrize("text", ["hf://a", "hf://", "hf://a/b@", "hf:///a/b", "hf://a b/c"])
def test_no_addresses(text):
    with pytest.raises(InputError, match="expected hf://OWNER/NAME"):
        parse_hub(text)


def test_a_file_is_downloaded_once_and_there_without_the_network(hub, monkeypatch):
    hub.repositories["a/b"] = {"w.bin": b"weights"}
    address = HubAddress("a/b", None, "w.bin")
    assert download_file(address, quiet=True).read_bytes() == b"weights"
    assert COMMIT in str(download_file(address, quiet=True))
    assert hub.asked
    monkeypatch.setenv(OFFLINE, "1")
    hub.asked.clear()
    assert download_file(address, quiet=True).read_bytes() == b"weights"
    assert hub.asked == []
    words = f"hf://a/b/other: found none in the hub's cache: {OFFLINE} forbids the network"
    with pytest.raises(InputError, match=re.escape(words)):
        download_file(HubAddress("a/b", None, "other"), quiet=True)


def test_a_file_of_a_data_set_goes_into_a_folder(hub, tmp_path):
    hub.repositories["datasets/a/b"] = {"data/x.tar": b"images"}
    address = HubAddress("a/b", None, "data/x.tar")
    file = download_file(address, is_dataset=True, folder=tmp_path / "to", quiet=True)
    assert file == tmp_path / "to" / "data" / "x.tar"
    assert file.read_bytes() == b"images"


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("hf://a/none/w", "hf://a/none/w: found no such repository, or a private one"),
        ("hf://a/b@v9/w", "hf://a/b@v9/w: found no such revision"),
        ("hf://a/b/x", "hf://a/b/x: found no x there, expected it"),
    ],
)
def test_what_is_not_there_is_one_line_without_the_token(hub, address, words):
    hub.repositories["a/b"] = {"w": b""}
    with pytest.raises(InputError) as error:
        download_file(parse_hub(address), quiet=True)
    assert str(error.value).startswith(words)
    assert "\n" not in str(error.value)
    assert TOKEN not in str(error.value)
    assert any(token == f"Bearer {TOKEN}" for _, _, token in hub.asked)  # and yet it was sent


def test_a_folder_is_uploaded_to_a_new_repository_alone(hub, tmp_path):
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "README.md").write_text("a card")
    (folder / "w.bin").write_bytes(bytes(range(256)))
    page = upload_folder(folder, parse_hub("hf://me/mine"), "a message", quiet=True)
    assert page.endswith("/me/mine")
    expected = {"README.md": b"a card", "w.bin": bytes(range(256))}
    assert hub.repositories["me/mine"].items() >= expected.items()
    assert hub.messages == ["a message"]
    with pytest.raises(InputError, match=r"found a repository with README.md, w.bin, expected"):
        upload_folder(folder, parse_hub("hf://me/mine"), "again", quiet=True)
    assert hub.messages == ["a message"]


@pytest.mark.parametrize(("code", "words"), [(401, "hf auth login"), (403, "HTTP 403")])
def test_an_upload_that_is_refused_is_one_line_without_the_token(hub, tmp_path, code, words):
    (tmp_path / "w.bin").write_bytes(b"")
    hub.refused = code
    with pytest.raises(InputError, match=words) as error:
        upload_folder(tmp_path, parse_hub("hf://me/mine"), "", quiet=True)
    assert "\n" not in str(error.value)
    assert TOKEN not in str(error.value)


def test_nothing_is_uploaded_without_the_network(hub, tmp_path, monkeypatch):
    monkeypatch.setenv(OFFLINE, "1")
    with pytest.raises(InputError, match=f"{OFFLINE} forbids the network"):
        upload_folder(tmp_path, parse_hub("hf://me/mine"), "")
    assert hub.asked == []


@pytest.mark.parametrize(
    ("module", "call"),
    [
        ("huggingface_hub", lambda folder: download_file(HubAddress("a/b", None, "w"))),
        ("huggingface_hub", lambda folder: upload_folder(folder, HubAddress("a/b"), "")),
        ("kagglehub", lambda folder: download_kaggle("a/b", folder)),
    ],
)
def test_a_client_that_is_not_installed_is_named_with_its_extra(
    monkeypatch, tmp_path, module, call
):
    monkeypatch.delenv(OFFLINE, raising=False)
    monkeypatch.setitem(sys.modules, module, None)
    words = f"a/b.*: found no module {module}, expected it with the extra data: pip install"
    with pytest.raises(ModuleNotFoundError, match=words):
        call(tmp_path)


def test_kaggle_stores_in_the_given_folder_and_its_errors_are_one_line(tmp_path, monkeypatch):
    """Its client is replaced: it knows no other server than Kaggle's."""
    import kagglehub

    def download(handle: str) -> str:
        if handle == "a/none":
            raise ValueError("404 Client Error.\nNot found\n")
        return f"{kagglehub.config.get_cache_folder()}/{handle}"

    monkeypatch.setattr(kagglehub, "dataset_download", download)
    assert download_kaggle("a/b", tmp_path, quiet=True) == tmp_path / "a" / "b"
    with pytest.raises(InputError, match=r"^kaggle: a/none: found 404 Client Error, expected"):
        download_kaggle("a/none", tmp_path, quiet=True)
