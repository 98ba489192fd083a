"""Downloads of sets from a server of the tests: laid out, resumed, and never half there."""

import dataclasses
import hashlib
import io
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import tarfile
import time
import zipfile
from collections.abc import Iterator

import cv2
import huggingface_hub.constants
import numpy as np
import pytest

from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.sets import SETS, PublishedSet, check_set, fetch_set
from crisalad_jax.data.sets.table import SetFile, SetPart
from crisalad_jax.utils import download as downloads
from crisalad_jax.utils.errors import InputError
from tests.file_server import FileServer, file_server
from tests.hub_server import hub_server


@pytest.fixture
def server(monkeypatch) -> Iterator[FileServer]:
    for name, value in (("_ATTEMPTS", 2), ("_PAUSE", 0.01)):
        monkeypatch.setattr(downloads, name, value)
    for name in (downloads.OFFLINE, "http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    with file_server() as server:
        yield server


def picture(number: int, suffix: str) -> bytes:
    image = np.full((8, 8, 3), number, np.uint8)
    return cv2.imencode(suffix, image)[1].tobytes()


def zipped(files: dict[str, bytes]) -> bytes:
    with zipfile.ZipFile(data := io.BytesIO(), "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return data.getvalue()


def tarred(files: dict[str, bytes]) -> bytes:
    with tarfile.open(fileobj=(data := io.BytesIO()), mode="w:gz") as archive:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return data.getvalue()


def offer(monkeypatch: pytest.MonkeyPatch, **fields: object) -> PublishedSet:
    """Put a set into the table under the name `tiny`."""
    known = {"host": "http", "page": "", "title": "", "command": "", "sources": ("a test",)}
    published = PublishedSet("tiny", **(known | fields))  # pyright: ignore
    monkeypatch.setitem(SETS, "tiny", published)
    return published


PAIRS = {f"new/{n:04}.png": picture(n, ".png") for n in (0, 3, 12)}
PAIRS |= {f"old/{n:04}.jpg": picture(n, ".jpg") for n in (0, 3, 12)}


@pytest.fixture
def pairs(server, monkeypatch) -> PublishedSet:
    others = {"A/deep/new/0099.png": b"", "A/deep/old/0099.jpg": b""}  # of the same names
    inner = zipped({f"Set-v1/{name}": data for name, data in PAIRS.items()} | others)
    server.files["/versions/4"] = zipped({"Set-v1.0.zip": inner, "description.md": b""})
    file = SetFile(server.url("/versions/4"), "data.zip", inside="Set-v1.0.zip")
    parts = (SetPart("test", 3, 3),)
    sides = {"database": "new", "queries": "old"}
    return offer(monkeypatch, files=(file,), pairs=sides, parts=parts)


def test_pairs_are_laid_out_as_evaluate_reads_them(pairs, tmp_path):
    to = fetch_set("tiny", tmp_path / "to", quiet=True)
    assert os.listdir(tmp_path) == ["to"]
    benchmark = open_benchmark(to)
    assert benchmark.name.startswith("to/test (@UTM placeholders 1 km apart: a place matches it")
    for query, positives in enumerate(benchmark.ground_truth()):
        (match,) = positives
        assert benchmark.queries[query].read_bytes() in PAIRS.values()
        asked = benchmark.queries[query].name.split("@")
        assert asked[7] == benchmark.database[match].name.split("@")[7]
        assert int(asked[7]) in (0, 3, 12)
        assert float(asked[2]) == 1000 * int(asked[7])
    (part,) = check_set(to, "tiny", quiet=True).parts
    assert (part.known, part.problem) == ("tiny, test", None)


def test_a_pair_without_its_other_half_is_refused(pairs, server, tmp_path):
    server.files["/versions/4"] = zipped(
        {"Set-v1.0.zip": zipped({"new/0001.png": b"", "old/0002.jpg": b"", "new/0002.png": b""})}
    )
    with pytest.raises(InputError, match=r"^tiny: .*found 1 images without their pair .0001."):
        fetch_set("tiny", tmp_path / "to", quiet=True)
    assert not (tmp_path / "to").exists()


def test_a_cut_is_resumed_and_the_folder_appears_whole(pairs, server, tmp_path):
    size = len(server.files["/versions/4"])
    server.cuts = [size // 2, 0]
    with pytest.raises(InputError, match=r"^tiny: .*the same command resumes"):
        fetch_set("tiny", tmp_path / "to", quiet=True)
    assert os.listdir(tmp_path) == ["to.part"]
    assert (tmp_path / "to.part" / "archives" / "data.zip.part").stat().st_size == size // 2
    server.asked.clear()
    fetch_set("tiny", tmp_path / "to", quiet=True)
    assert server.asked == [("/versions/4", f"bytes={size // 2}-")]
    assert os.listdir(tmp_path) == ["to"]
    assert len(open_benchmark(tmp_path / "to").database) == 3


KILLED = """
import sys
from crisalad_jax.data.sets import SETS, PublishedSet, fetch_set
from crisalad_jax.data.sets.table import SetFile
file = SetFile(sys.argv[1], "data.zip")
known = {"host": "http", "page": "", "title": "", "command": "", "sources": ()}
SETS["tiny"] = PublishedSet("tiny", files=(file,), **known)
fetch_set("tiny", sys.argv[2], quiet=True)
"""


def test_a_killed_download_is_resumed(pairs, server, tmp_path):
    server.stalls = 1  # after ten bytes
    given = [sys.executable, "-c", KILLED, server.url("/versions/4"), str(tmp_path / "to")]
    part = tmp_path / "to.part" / "archives" / "data.zip.part"
    with subprocess.Popen(given) as child:
        while child.poll() is None and not (part.exists() and part.stat().st_size == 10):
            time.sleep(0.05)
        child.kill()
    assert child.returncode == -signal.SIGKILL
    assert os.listdir(tmp_path) == ["to.part"]
    server.asked.clear()
    fetch_set("tiny", tmp_path / "to", quiet=True)
    assert server.asked == [("/versions/4", "bytes=10-")]
    assert os.listdir(tmp_path) == ["to"]


def test_lists_get_the_names_that_evaluate_reads(server, monkeypatch, tmp_path):
    def array(values: object) -> bytes:
        np.save(data := io.BytesIO(), np.array(values))
        return data.getvalue()

    files = {f"{n}.jpg": picture(n, ".jpg") for n in range(3)}
    files |= {"v_ref_image_names.npy": array(["0.jpg", "1.jpg"]), "v_qImages.npy": array(["2.jpg"])}
    files["v_gt_25m.npy"] = array([[1]])
    server.files["/v.zip"] = zipped({f"v/{name}": data for name, data in files.items()})
    renamed = {"v_ref_image_names.npy": "v_dbImages.npy", "v_gt_25m.npy": "v_gt.npy"}
    offer(monkeypatch, files=(SetFile(server.url("/v.zip")),), renamed=renamed)
    benchmark = open_benchmark(fetch_set("tiny", tmp_path / "to", quiet=True))
    assert benchmark.name == "v (SALAD's lists)"
    assert [path.name for path in benchmark.database] == ["0.jpg", "1.jpg"]
    assert [each.tolist() for each in benchmark.ground_truth()] == [[1]]


def test_nordland_is_made_of_the_listed_frames_of_two_rides(monkeypatch, tmp_path):
    """The table's own entry, from a hub of the tests, with 30 frames of which 24 are listed."""
    monkeypatch.delenv(downloads.OFFLINE, raising=False)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    listed = [f"images-{n:05}.png" for n in range(1, 31) if n % 5]
    with hub_server(monkeypatch) as hub:
        rides = {
            season: tarred(
                {f"{season}/images-{n:05}.png": picture(first + n, ".png") for n in range(1, 31)}
            )
            for season, first in (("summer", 0), ("winter", 100))
        }
        hub.repositories["datasets/Somayeh-h/Nordland"] = {
            **{f"data/{season}.tar.gz": data for season, data in rides.items()},
            "dataset_imageNames/nordland_imageNames.txt": "\n".join(listed).encode(),
        }
        monkeypatch.setitem(SETS, "nordland", dataclasses.replace(SETS["nordland"], gigabytes=None))
        fetch_set("nordland", tmp_path / "to", quiet=True)
    benchmark = open_benchmark(tmp_path / "to")
    assert benchmark.name.startswith("Nordland, Patch-NetVLAD split (summer database, winter quer")
    frames = [int(name[7:12]) for name in listed]
    for first, side in ((0, benchmark.database), (100, benchmark.queries)):
        assert [cv2.imread(str(path))[0, 0, 0] - first for path in side] == frames
    # Ten listed frames to each side: 25 m.
    assert [each.tolist() for each in benchmark.ground_truth()] == [
        list(range(max(0, i - 10), min(24, i + 11))) for i in range(24)
    ]
    (part,) = check_set(tmp_path / "to", "nordland", quiet=True).parts
    assert part.problem is not None
    assert "found 24 database images and 24 queries, expected those of nordland" in part.problem


def test_a_digest_is_compared_and_another_file_is_downloaded_again(server, monkeypatch, tmp_path):
    right = zipped({"set/Dataframes/a.csv": b"1", "set/Images/a.jpg": b"2"})
    digest = hashlib.sha256(right).hexdigest()
    offer(monkeypatch, files=(SetFile(server.url("/a.zip"), sha256=digest),))
    server.files["/a.zip"] = zipped({"other": b""})
    with pytest.raises(InputError, match=f"found SHA-256 .*, expected {digest[:12]}"):
        fetch_set("tiny", tmp_path / "to", quiet=True)
    server.files["/a.zip"] = b"<html>Quota exceeded</html>"
    offer(monkeypatch, files=(SetFile(server.url("/a.zip")),))
    with pytest.raises(InputError, match="found a page of HTML, expected an archive"):
        fetch_set("tiny", tmp_path / "to", quiet=True)
    assert not (tmp_path / "to").exists()
    server.files["/a.zip"] = right
    to = fetch_set("tiny", tmp_path / "to", quiet=True)
    assert sorted(os.listdir(to)) == ["Dataframes", "Images"]  # without the folder around them


def test_kaggle_s_files_are_taken_from_its_client(monkeypatch, tmp_path):
    """The client is replaced: it knows no other server than Kaggle's."""
    import kagglehub

    def download(handle: str) -> str:
        version = pathlib.Path(kagglehub.config.get_cache_folder()) / handle / "versions" / "1"
        (version / "Images").mkdir(parents=True)
        (version / "Dataframes").mkdir()
        return str(version)

    monkeypatch.delenv(downloads.OFFLINE, raising=False)
    monkeypatch.setattr(kagglehub, "dataset_download", download)
    offer(monkeypatch, host="kaggle", files=(SetFile("a/b"),))
    to = fetch_set("tiny", tmp_path / "to", quiet=True)
    assert sorted(os.listdir(to)) == ["Dataframes", "Images"]
    assert os.listdir(tmp_path) == ["to"]


def test_rsync_is_asked_for_a_folder(monkeypatch, tmp_path):
    """A program of the tests stands for it: it copies a folder, or fails as rsync does."""
    monkeypatch.delenv(downloads.OFFLINE, raising=False)
    programs = tmp_path / "programs"
    programs.mkdir()
    address = f"{tmp_path}/remote"
    offer(monkeypatch, host="rsync", files=(SetFile(address),))
    monkeypatch.setenv("PATH", str(programs))
    with pytest.raises(InputError, match="found no program rsync, expected one"):
        fetch_set("tiny", tmp_path / "to", quiet=True)
    python = shutil.which("python3", path=os.defpath) or "/usr/bin/python3"
    program = programs / "rsync"
    program.write_text(
        f"#!{python}\nimport shutil, sys\n*flags, source, target = sys.argv[1:]\n"
        "assert '--partial' in flags\n"
        "try:\n    shutil.copytree(source, target)\n"
        "except OSError:\n    sys.exit('rsync: connection refused')\n"
    )
    program.chmod(0o755)
    with pytest.raises(InputError, match=r"rsync's code 1 .rsync: connection refused., expected 0"):
        fetch_set("tiny", tmp_path / "to", quiet=True)
    (tmp_path / "remote" / "images").mkdir(parents=True)
    (tmp_path / "remote" / "map.png").write_bytes(b"")
    to = fetch_set("tiny", tmp_path / "to", quiet=True)
    assert sorted(os.listdir(to)) == ["images", "map.png"]
    (tmp_path / "remote" / "map.png").unlink()
    (tmp_path / "remote" / "images" / "test" / "database").mkdir(parents=True)
    to = fetch_set("tiny", tmp_path / "bare", quiet=True)
    assert os.listdir(to) == ["images"]  # which is the set's, not a folder around it


def test_what_cannot_begin_writes_nothing(pairs, server, monkeypatch, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="found a folder with files in it, expected a new or"):
        fetch_set("tiny", tmp_path / "full", quiet=True)
    monkeypatch.setitem(SETS, "tiny", dataclasses.replace(pairs, gigabytes=1e9))
    with pytest.raises(InputError, match=r"GB of free disk, expected 2100000000.0 GB for tiny"):
        fetch_set("tiny", tmp_path / "to", quiet=True)
    monkeypatch.setitem(SETS, "tiny", pairs)
    monkeypatch.setenv(downloads.OFFLINE, "1")
    with pytest.raises(InputError, match=r"^tiny: CRISALAD_OFFLINE forbids the network"):
        fetch_set("tiny", tmp_path / "to", quiet=True)
    with pytest.raises(InputError, match=r"^msls: found a set that only a person can get .log in"):
        fetch_set("msls", tmp_path / "to", quiet=True)
    assert os.listdir(tmp_path) == ["full"]
    assert server.asked == []
