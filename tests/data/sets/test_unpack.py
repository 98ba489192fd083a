"""Archives of others: what is in them, and nothing outside of the folder."""

import contextlib
import io
import pathlib
import shutil
import stat
import tarfile
import zipfile

import pytest

from crisalad_jax.data.sets.unpack import is_archive, unpack
from crisalad_jax.utils.errors import InputError

FILES = {"set/a.txt": b"a" * 3000, "set/deep/b.txt": b"b", "empty.txt": b""}


def write_zip(path: pathlib.Path, files: dict[str, bytes]) -> pathlib.Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def write_tar(path: pathlib.Path, files: dict[str, bytes]) -> pathlib.Path:
    with tarfile.open(path, "w:gz" if path.suffix == ".gz" else "w") as archive:
        for name, data in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    return path


WRITERS = {"a.zip": write_zip, "a.tar": write_tar, "a.tar.gz": write_tar}


def written(folder: pathlib.Path) -> dict[str, bytes]:
    paths = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


@pytest.mark.parametrize("name", WRITERS)
def test_files_and_folders_are_unpacked(tmp_path, name):
    unpack(WRITERS[name](tmp_path / name, FILES), tmp_path / "to", quiet=True)
    assert written(tmp_path / "to") == FILES
    assert is_archive(name)


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("inside", ["../out.txt", "/out.txt", "a/../../out.txt", "..\\out", "C:/o"])
def test_no_name_leads_out(tmp_path, name, inside):
    archive = WRITERS[name](tmp_path / name, {inside: b"x"})
    folder = tmp_path / "deep" / "to"
    with contextlib.suppress(InputError):
        unpack(archive, folder, quiet=True)
    others = {path for path in tmp_path.rglob("*") if path.is_file() and folder not in path.parents}
    assert others == {archive}


def tar_of(path: pathlib.Path, kind: bytes) -> pathlib.Path:
    with tarfile.open(path, "w") as archive:
        info = tarfile.TarInfo("link")
        info.type, info.linkname = kind, "/etc/passwd"
        archive.addfile(info)
    return path


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE])
def test_links_out_and_devices_are_refused(tmp_path, kind):
    with pytest.raises(InputError, match=r"a\.tar: cannot be unpacked: "):
        unpack(tar_of(tmp_path / "a.tar", kind), tmp_path / "to", quiet=True)
    assert list((tmp_path / "to").iterdir()) == []


def test_a_link_in_a_zip_is_no_link(tmp_path):
    info = zipfile.ZipInfo("link")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr(info, "/etc/passwd")
    unpack(tmp_path / "a.zip", tmp_path / "to", quiet=True)
    assert (tmp_path / "to" / "link").read_text() == "/etc/passwd"
    assert not (tmp_path / "to" / "link").is_symlink()


@pytest.mark.parametrize("name", WRITERS)
def test_a_cut_or_another_file_is_one_line(tmp_path, name):
    archive = WRITERS[name](tmp_path / name, FILES)
    data = archive.read_bytes()
    for other, words in (
        (data[: len(data) // 3], "cannot be unpacked"),
        (b"nothing of the kind" * 100, "cannot be unpacked"),
        (b"<!DOCTYPE html><title>Quota exceeded</title>", "found a page of HTML, expected an arch"),
    ):
        archive.write_bytes(other)
        with pytest.raises(InputError, match=words) as error:
            unpack(archive, tmp_path / "to", quiet=True)
        assert "\n" not in str(error.value)


def test_more_than_the_disk_has_room_for_is_not_begun(tmp_path, monkeypatch):
    archive = write_zip(tmp_path / "a.zip", {"zeros": bytes(10**6)})  # a kilobyte on the disk
    usage = shutil.disk_usage(tmp_path)._replace(free=999_999)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    with pytest.raises(InputError, match=r"found 0.0 GB in it and 0.0 GB of free disk"):
        unpack(archive, tmp_path / "to", quiet=True)
    assert written(tmp_path / "to") == {}
