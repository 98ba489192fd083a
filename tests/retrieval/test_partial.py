"""Extractions that are cut short: what is done is kept, and the files are of one set or none."""

import hashlib
import json
import os
import pathlib
import shutil
import subprocess
import sys
import warnings

import h5py
import jax
import numpy as np
import pytest

from crisalad_jax.data.images import list_images
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval import extract as extract_module
from crisalad_jax.retrieval import on_cluster
from crisalad_jax.retrieval.descriptor_files import read_descriptors, write_descriptors
from crisalad_jax.retrieval.extract import Extracted, extract
from crisalad_jax.retrieval.segments import Segments
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import write_json
from crisalad_jax.utils.output import Note
from tests.conftest import BATCH, MODEL, read_options, write_picture

ROOT = pathlib.Path(__file__).parents[2]
IMAGES = 12
PARTS = IMAGES // BATCH

# A child for each rename, which dies before it; prints how many there are.
KILLED_WRITES = """
import os, pathlib, signal, sys
import numpy as np
from crisalad_jax.retrieval.descriptor_files import write_descriptors

folder, suffix = pathlib.Path(sys.argv[1]), sys.argv[2]
old, new = (np.load(folder / name) for name in ("old.npy", "new.npy"))
names = (folder / "names.txt").read_text().splitlines()
real = os.replace
step = 0
while True:
    out = folder / str(step) / f"d{suffix}"
    write_descriptors(out, old, names[: len(old)], {"set": "old"})
    child = os.fork()
    if child == 0:
        left = step

        def dying(*arguments):
            global left
            if not left:
                os.kill(os.getpid(), signal.SIGKILL)
            left -= 1
            real(*arguments)

        os.replace = dying
        write_descriptors(out, new, names, {"set": "new"})
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code == 0:
        break
    assert code == -signal.SIGKILL, code
    step += 1
print(step)
"""


def run(params, images, out, **options) -> Extracted:
    return extract(Model(params, MODEL), images, out, **read_options(options))


def contents(folder: pathlib.Path) -> dict[str, bytes]:
    """All files, hidden ones included."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def town(shared) -> pathlib.Path:
    images = shared / "town"
    assert len(list_images(images)) == IMAGES
    return images


@pytest.fixture(scope="module")
def whole(params, town, tmp_path_factory) -> dict[str, bytes]:
    """The files of an extraction that nothing interrupts, in one segment."""
    folder = tmp_path_factory.mktemp("whole")
    run(params, town, folder / "d.npy")
    found = contents(folder)
    assert found.keys() == {"d.npy", "d.names.txt", "d.npy.json"}
    return found


@pytest.fixture
def described(monkeypatch) -> list[str]:
    """The names of the images that are computed from now on; a batch makes a segment."""
    names: list[str] = []

    def spied(real):
        def stream(describer, paths, *given, **options):
            names.extend(path.name for path in paths)
            return real(describer, paths, *given, **options)

        return stream

    monkeypatch.setattr(extract_module, "SEGMENT", 1)
    for name in ("described", "token_rows"):
        monkeypatch.setattr(on_cluster, name, spied(getattr(on_cluster, name)))
    return names


def names_from(town: pathlib.Path, first: int) -> list[str]:
    return [path.name for path in list_images(town)[first:]]


def cut_short(monkeypatch, params, images, out, *, after: int, error=KeyboardInterrupt, **options):
    """Run until so many segments are there, and then into an error."""
    real, left = Segments.append, after

    def failing(*arguments):
        nonlocal left
        real(*arguments)
        left -= 1
        if not left:
            raise error("cut short")

    with monkeypatch.context() as patch:
        patch.setattr(Segments, "append", failing)
        with pytest.raises(error) as caught:
            run(params, images, out, **options)
    return caught.value


def segments(out: pathlib.Path) -> list[str]:
    return sorted(path.name for path in out.with_name(f"{out.name}.partial").glob("[0-9]*.json"))


# What is done is kept


@pytest.mark.filterwarnings("error::crisalad_jax.utils.output.Note")
@pytest.mark.parametrize("error", [KeyboardInterrupt, InputError])
@pytest.mark.parametrize("after", range(1, PARTS + 1))
def test_the_same_call_does_the_rest_with_the_same_bits(
    params, town, whole, described, tmp_path, monkeypatch, after, error
):
    out = tmp_path / "d.npy"
    found = cut_short(monkeypatch, params, town, out, after=after, error=error)
    kept = [f"{BATCH * i:010d}" for i in range(after)]
    assert segments(out) == [f"{name}.json" for name in kept]
    assert os.listdir(tmp_path) == ["d.npy.partial"]
    assert set(os.listdir(tmp_path / "d.npy.partial")) == {
        *(f"{name}{suffix}" for name in kept for suffix in (".json", ".npy"))
    }
    if error is InputError:
        advice = f"finished work is stored in {out}.partial: the same command resumes"
        assert str(found) == f"cut short ({advice})"
    described.clear()
    result = run(params, town, out)
    assert described == names_from(town, BATCH * after)
    assert contents(tmp_path) == whole
    assert result.descriptors.tobytes() == np.load(out).tobytes()


def test_what_a_kill_leaves_within_the_folder_does_no_harm(
    params, town, whole, described, tmp_path, monkeypatch
):
    """Its lock, and a segment under a temporary name."""
    out = tmp_path / "d.npy"
    cut_short(monkeypatch, params, town, out, after=1)
    folder = tmp_path / "d.npy.partial"
    (folder / ".crisalad-lock").write_text("process 1 on elsewhere\n")
    half = folder / ".crisalad-0123456789ab.npy"
    half.write_bytes(b"half")
    described.clear()
    real, there = Segments.append, []
    monkeypatch.setattr(
        Segments, "append", lambda *given: (there.append(half.exists()), real(*given))
    )
    run(params, town, out)
    assert there == [False] * (PARTS - 1)  # its space is needed
    assert described == names_from(town, BATCH)
    assert contents(tmp_path) == whole


@pytest.mark.parametrize("grouping", ["sequential", "window", "shuffled"])
def test_what_is_done_serves_other_groupings_too(
    params, town, described, tmp_path, monkeypatch, grouping
):
    """Tokens do not depend on which of these it is, nor on the name of the weights."""
    out = tmp_path / "d.npy"
    cut_short(monkeypatch, params, town, out, after=2, grouping="window")
    described.clear()
    found = run(params, town, out, grouping=grouping, weights="w.safetensors", seed=3)
    assert described == names_from(town, 2 * BATCH)
    expected = run(params, town, tmp_path / "e.npy", grouping=grouping, seed=3)
    assert found.descriptors.tobytes() == expected.descriptors.tobytes()
    alone = run(params, town, tmp_path / "f.npy")
    assert not np.allclose(found.descriptors, alone.descriptors, atol=1e-4)


def test_an_image_that_is_skipped_is_skipped_again(params, town, described, tmp_path, monkeypatch):
    images, out = tmp_path / "town", tmp_path / "d.npy"
    shutil.copytree(town, images)
    bad = list_images(images)[1]
    bad.write_bytes(b"no image")
    cut_short(monkeypatch, params, images, out, after=2, on_bad_image="skip")
    described.clear()
    found = run(params, images, out, on_bad_image="skip")
    assert described == names_from(images, 2 * BATCH)
    assert found.skipped == [bad.relative_to(images).as_posix()]
    expected = run(params, images, tmp_path / "e.npy", on_bad_image="skip")
    assert found.descriptors.tobytes() == expected.descriptors.tobytes()
    assert found.names == expected.names
    # Where it is an error, it is one however much is done.
    cut_short(monkeypatch, params, images, out, after=2, on_bad_image="skip")
    with pytest.raises(
        InputError, match=rf"{bad.name}.* \(finished work is stored in {out}\.partial"
    ):
        run(params, images, out)


@pytest.mark.parametrize("part", [".json", ".npy"])
@pytest.mark.parametrize("how", ["flipped", "cut", "removed"])
def test_what_is_damaged_is_described_again(
    params, town, whole, described, tmp_path, monkeypatch, how, part
):
    """From the beginning. A note says so."""
    out = tmp_path / "d.npy"
    cut_short(monkeypatch, params, town, out, after=PARTS)
    folder = tmp_path / "d.npy.partial"
    path = folder / f"{BATCH:010d}{part}"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data if how == "flipped" else data[:-5])
    if how == "removed":
        path.unlink()
    described.clear()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", Note)
        run(params, town, out)
    assert described == names_from(town, 0)
    (note,) = (str(one.message) for one in told if issubclass(one.category, Note))
    assert "starting again" in note
    assert contents(tmp_path) == whole


# One at a time, and nothing left


@pytest.mark.parametrize("there", [False, True])
def test_a_failure_before_anything_is_done_leaves_nothing(params, town, tmp_path, there):
    images, out = tmp_path / "town", tmp_path / "new" / "deep" / "d.npy"
    shutil.copytree(town, images)
    list_images(images)[0].write_bytes(b"no image")
    if there:
        write_descriptors(out, np.eye(2, dtype=np.float32), ["a", "b"])
    before = contents(tmp_path)
    with pytest.raises(InputError) as error:
        run(params, images, out)
    assert "is stored" not in str(error.value)
    assert contents(tmp_path) == before
    assert (tmp_path / "new").exists() == there
    if there:
        assert "d.npy.partial" not in os.listdir(out.parent)


@pytest.mark.parametrize("other", ["model", "first picture", "last picture", "fewer", "order"])
def test_other_work_is_begun_anew_with_a_note(
    params, town, described, tmp_path, monkeypatch, other
):
    images, out = tmp_path / "town", tmp_path / "d.npy"
    shutil.copytree(town, images)
    listed = list_images(images)
    cut_short(monkeypatch, params, listed, out, after=2)
    place = {"first picture": 0, "last picture": -1}.get(other)
    if place is not None:
        write_picture(listed[place], seed=99)
    if other == "model":
        params = jax.tree.map(lambda leaf: leaf * 0.9, params)
    listed = {"fewer": listed[:-1], "order": listed[::-1]}.get(other, listed)
    described.clear()
    words = r"d\.npy\.partial: found results for another model, batch size or images; starting"
    with pytest.warns(Note, match=words) as told:
        found = run(params, listed, out)
    assert described == [path.name for path in listed]
    assert len(told) == 1
    assert not out.with_name("d.npy.partial").exists()
    alone = run(params, listed, tmp_path / "alone.npy")
    np.testing.assert_array_equal(found.descriptors, alone.descriptors)


# The files of a set


@pytest.mark.parametrize(("suffix", "renames"), [(".npy", 3), (".h5", 2)])
def test_a_set_that_is_killed_between_its_renames_is_whole_or_refused(
    params, town, whole, described, tmp_path, suffix, renames
):
    """And the same extraction mends it, with nothing of the old set left."""
    renames += 1  # of the record under its temporary name
    names = whole["d.names.txt"].decode().splitlines()
    (tmp_path / "new.npy").write_bytes(whole["d.npy"])
    new = np.load(tmp_path / "new.npy")
    old = np.roll(new, 1, axis=0)
    np.save(tmp_path / "old.npy", old)
    (tmp_path / "names.txt").write_bytes(whole["d.names.txt"])
    program = [sys.executable, "-c", KILLED_WRITES, str(tmp_path), suffix]
    done = subprocess.run(program, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, f"{renames}\n"), done.stderr

    def rows(step: int) -> np.ndarray:
        listed, found = read_descriptors(tmp_path / str(step) / f"d{suffix}")
        by_name = dict(zip(listed, found, strict=True))
        assert by_name.keys() == set(names)
        return np.stack([by_name[name] for name in names])

    for step in (0, 1):
        np.testing.assert_array_equal(rows(step), old)
    for step in range(2, renames):
        with pytest.raises(InputError) as error:
            rows(step)
        words = f"found other bytes than d{suffix}.json says, expected those that were written tog"
        assert words in str(error.value)
        assert "\n" not in str(error.value)
    np.testing.assert_array_equal(rows(renames), new)
    for step in range(renames):
        run(params, town, tmp_path / str(step) / f"d{suffix}")
        np.testing.assert_array_equal(rows(step), new)
        if suffix == ".npy":
            files = contents(tmp_path / str(step))
            assert {name: files[name] for name in whole} == whole


@pytest.mark.parametrize("suffix", [".npy", ".h5"])
def test_the_record_holds_the_digests_of_the_files(tmp_path, suffix):
    out = tmp_path / f"d{suffix}"
    write_descriptors(out, np.eye(2, dtype=np.float32), ["a", "b"], {"seed": 3})
    record = json.loads((tmp_path / f"d{suffix}.json").read_text())
    files = {"descriptors": out} | ({"names": tmp_path / "d.names.txt"} if suffix == ".npy" else {})
    assert record["files"] == {
        role: hashlib.sha256(path.read_bytes()).hexdigest() for role, path in files.items()
    }
    assert record["seed"] == 3
    for path in files.values():
        data = bytearray(path.read_bytes())
        for place in (0, len(data) // 2, len(data) - 1):
            path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
            with pytest.raises(InputError, match=f"^{path}: found other bytes than d"):
                read_descriptors(out)
        path.write_bytes(data)
    assert sorted(read_descriptors(out)[0]) == ["a", "b"]


@pytest.mark.parametrize(
    "record", [{"seed": 3}, {"files": {"descriptors": "0" * 64}}, {"files": []}]
)
def test_a_record_of_something_else_is_refused(tmp_path, record):
    out = tmp_path / "d.npy"
    write_descriptors(out, np.eye(2, dtype=np.float32), ["a", "b"])
    write_json(tmp_path / "d.npy.json", record)
    with pytest.raises(InputError, match=r"d\.npy: found other bytes than d\.npy\.json says"):
        read_descriptors(out)
    assert read_descriptors(out, verify=False)[0] == ["a", "b"]


@pytest.mark.filterwarnings("error::crisalad_jax.utils.output.Note")
def test_a_set_without_a_record_is_read_with_a_note(tmp_path):
    """As numpy and hloc write them."""
    np.save(tmp_path / "d.npy", np.eye(2, dtype=np.float32))
    (tmp_path / "d.names.txt").write_text("a\nb\n")
    with h5py.File(tmp_path / "d.h5", "w") as file:
        for name, row in zip(("a", "b"), np.eye(2), strict=True):
            file.create_dataset(f"{name}/global_descriptor", data=row)
    for name in ("d.npy", "d.h5"):
        with pytest.warns(Note, match=rf"{name}: found no .*checksum") as told:
            names, found = read_descriptors(tmp_path / name)
        assert len(told) == 1
        assert names == ["a", "b"]
        np.testing.assert_array_equal(found, np.eye(2))
        read_descriptors(tmp_path / name, verify=False)
