"""Images at addresses: in fsspec's memory, over HTTP, and in an S3 server of moto."""

import logging
import pathlib
from typing import Any

import fsspec
import numpy as np
import pytest

from crisalad_jax.data.file_cache import FileCache
from crisalad_jax.data.images import read_image
from crisalad_jax.data.loader import ImageCache, training_batches
from crisalad_jax.data.places import Places, read_places
from crisalad_jax.data.positions import Positions, exif_position
from crisalad_jax.data.reading import image_batches
from crisalad_jax.data.remote import address_of, is_remote, size_of, state_of
from crisalad_jax.data.sources import open_source, open_sources
from crisalad_jax.utils.errors import InputError
from tests.conftest import write_city, write_picture
from tests.data.benchmarks.trees import refused
from tests.data.test_sources import write_jpeg
from tests.file_server import file_server

NAMES = ["a.png", "left/b.png", "left/deep/c.png"]


@pytest.fixture
def pictures(tmp_path) -> dict[str, bytes]:
    for number, name in enumerate(NAMES):
        write_picture(tmp_path / name, number)
    return {name: (tmp_path / name).read_bytes() for name in NAMES}


@pytest.fixture
def memory(pictures):
    files = fsspec.filesystem("memory")
    others = {"notes.md": b"x", ".hidden/d.png": b"x", "left/.e.png": b"x"}
    for name, data in (pictures | others).items():
        files.pipe(f"/run/{name}", data)
    yield files
    files.rm("/run", recursive=True)


def test_paths_hold_addresses():
    for text in ("s3://bucket/a b.jpg", "https://host:8000/x/y.png", "gs://b", "s3a://b/c"):
        assert is_remote(text)
        assert address_of(pathlib.Path(text)) == text
    for text in ("/a/b.jpg", "C:/a.jpg", "a.jpg", "walk.mp4#t=1.000", "dir/s3://b"):
        assert not is_remote(text)
        assert address_of(text) == text


@pytest.mark.filterwarnings("ignore:.*skipped 1 other file. 1 .md")
@pytest.mark.parametrize(
    ("given", "root", "names"),
    [
        ("memory://run", "memory:/run", NAMES),
        (pathlib.Path("memory://run"), "memory:/run", NAMES),
        ("memory://run/left/", "memory:/run/left", ["b.png", "deep/c.png"]),
        ("memory://run/*", "memory:/run", ["a.png"]),
        ("memory://run/**/[bc].png", "memory:/run", NAMES[1:]),
        ("memory://run/left/b.png", "memory:/run/left", ["b.png"]),
    ],
)
def test_sources_at_addresses(memory, pictures, tmp_path, given, root, names):
    source = open_source(given)
    assert (source.root, source.names) == (pathlib.Path(root), names)
    for path in source.paths:
        name = path.relative_to("memory:/run").as_posix()
        np.testing.assert_array_equal(read_image(path), read_image(tmp_path / name))
        assert size_of(path) == len(pictures[name])


def test_new_files_are_seen_and_changes_too(memory, pictures):
    open_source("memory://run/left")
    before = state_of(pathlib.Path("memory://run/left/b.png"))
    memory.pipe("/run/left/z.png", pictures["a.png"])
    memory.pipe("/run/left/b.png", pictures["a.png"])
    assert open_source("memory://run/left").names == ["b.png", "deep/c.png", "z.png"]
    assert state_of(pathlib.Path("memory://run/left/b.png")) != before


def test_lists_and_tables_of_addresses(memory, tmp_path):
    (tmp_path / "some.txt").write_text("memory://run/left/b.png\nmemory://run/a.png\n")
    source = open_source(tmp_path / "some.txt")
    assert (source.root, source.names) == (pathlib.Path("memory:/run"), ["left/b.png", "a.png"])
    (tmp_path / "some.csv").write_text("File,x,y\nmemory://run/a.png,1,2\n")
    assert open_source(tmp_path / "some.csv").positions == Positions(("x", "y"), {"a.png": (1, 2)})
    for line, words in (
        ("memory://else/a.png", "addresses of memory://else and memory://run, expected those of"),
        ("a.png", "found a.png among addresses"),
        ("memory://run/walk.mp4", "found memory:/run/walk.mp4 among addresses, expected images"),
    ):
        (tmp_path / "some.txt").write_text(f"memory://run/a.png\n{line}\n")
        with refused(f"some.txt: .*{words}"):
            open_source(tmp_path / "some.txt")


def test_exif_at_an_address(memory, tmp_path):
    memory.pipe("/run/e.jpg", write_jpeg(tmp_path / "e.jpg").read_bytes())
    expected = exif_position(tmp_path / "e.jpg")
    assert expected is not None
    assert open_source("memory://run/e.jpg").located().of == {"e.jpg": expected}


def test_what_cannot_be_read_is_a_line(memory):
    with refused("^memory://run/gone.png: cannot be read: found no such file"):
        read_image("memory://run/gone.png")
    with refused("^memory://run/notes.md: found 1 bytes that do not decode"):
        read_image("memory://run/notes.md")
    assert size_of(pathlib.Path("memory://run/gone.png")) is None
    assert state_of(pathlib.Path("memory://run/gone.png")) is None
    with refused("^memory://run/none: found no folder there"):
        open_source("memory://run/none")
    with refused("^memory://run/[*].gif: found no image"):
        open_source("memory://run/*.gif")
    with refused("^nosuch://bucket/a.png: cannot be read: Protocol not known"):
        read_image("nosuch://bucket/a.png")
    with refused("^gs://bucket/a.png: cannot be read: .*gcsfs"):
        read_image("gs://bucket/a.png")
    batch = next(
        image_batches(
            ["memory://run/gone.png", "memory://run/a.png"],
            image_size=(14, 14),
            batch_size=2,
            on_bad_image="skip",
        )
    )
    assert batch.valid.tolist() == [False, True]


@pytest.mark.parametrize(
    "address", ["https://me:pa55@host/a.png", "https://pa55@host/run", "http://host/a?key=pa55"]
)
def test_secrets_are_neither_taken_nor_repeated(tmp_path, address):
    (tmp_path / "some.txt").write_text(address)
    for read in (open_source, read_image, lambda _: open_source(tmp_path / "some.txt")):
        with pytest.raises(
            InputError, match=r"^https?://host/(a|a.png|run): found a user"
        ) as caught:
            read(address)
        assert "pa55" not in str(caught.value)


def test_without_fsspec_a_line_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "fsspec.core", None)
    with refused(r"^ftp://h/a.png: found no module fsspec, expected it with the extra robot"):
        read_image("ftp://h/a.png")


def test_over_http(pictures, tmp_path):
    with file_server() as server:
        server.files |= {f"/run/{name}": data for name, data in pictures.items()}
        links = "".join(f'<a href="{name}">x</a>' for name in ("a.png", "notes.md"))
        server.files["/run"] = server.files["/run/"] = links.encode()
        source = open_source(server.url("/run/a.png"))
        assert source.names == ["a.png"]
        np.testing.assert_array_equal(read_image(source.paths[0]), read_image(tmp_path / "a.png"))
        assert size_of(source.paths[0]) == len(pictures["a.png"])
        with refused("/run/gone.png: cannot be read: found no such file"):
            read_image(server.url("/run/gone.png"))
        server.statuses = [500]
        with refused("/run/a.png: cannot be read: 500"):
            read_image(source.paths[0])
        server.cuts = [10]
        with refused("/run/a.png: cannot be read: "):
            read_image(source.paths[0])
    with refused("/run/a.png: cannot be read: Cannot connect"):
        read_image(source.paths[0])


def test_files_and_addresses_do_not_mix(memory, tmp_path):
    from crisalad_jax.retrieval.maps.query import _below_one_root

    write_picture(tmp_path / "a.png", 1)
    with refused("found files and addresses, expected only one of the two"):
        _below_one_root(open_sources([tmp_path / "a.png", "memory://run/a.png"]))
    given = ["memory://run/a.png", "memory://run/left/b.png"]
    root, ((*paths,),) = _below_one_root(open_sources(given))
    assert (root, paths) == (pathlib.Path("memory:/run"), list(map(pathlib.Path, given)))


def write_layouts(folder: pathlib.Path) -> None:
    """Places in the layout of GSV-Cities, as folders, and in a table."""
    write_city(folder / "city")
    for number in range(6):
        write_picture(folder / "folders" / f"p{number % 3}" / f"{number}.png", number)
        write_picture(folder / "table" / "all" / f"{number}.png", number)
    rows = [f"all/{number}.png,{'ab'[number % 2]},1.5,{number}" for number in range(6)]
    (folder / "table" / "places.csv").write_text("\n".join(["name,place,lat,lon", *rows]))


@pytest.fixture
def layouts(tmp_path):
    write_layouts(tmp_path)
    files = fsspec.filesystem("memory")
    files.put(str(tmp_path), "/run", recursive=True)
    yield files
    files.rm("/run", recursive=True)


def same_places(found: Places, expected: Places) -> bool:
    for name in ("place_start", "place_city", "views"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    return (found.files, found.names, found.cities) == (
        expected.files,
        expected.names,
        expected.cities,
    )


@pytest.mark.parametrize("name", ["city", "folders", "table", "table/places.csv"])
def test_places_at_addresses(layouts, tmp_path, name):
    given: Any = {"min_images": 2}
    found, expected = (read_places(f"{at}/{name}", **given) for at in ("memory://run", tmp_path))
    assert same_places(found, expected)
    assert found.path(0) == pathlib.Path("memory:/run", name.partition("/")[0], found.files[0])
    cache = ImageCache(0, read_far=FileCache(tmp_path / "cache", 2**30).read)
    drawn: Any = {
        **{"image_size": (14, 14), "places_per_batch": 2, "images_per_place": 2, "seed": 3},
        **{"epoch": 0, "sampler": "shuffled", "augmentation": "light", "threads": 2},
    }
    batches = training_batches(found, cache=cache, **drawn)
    for batch, other in zip(batches, training_batches(expected, **drawn), strict=True):
        for ours, theirs in zip(batch, other, strict=True):
            np.testing.assert_array_equal(ours, theirs)
    assert any((tmp_path / "cache").rglob("*"))


@pytest.mark.filterwarnings("ignore:.*left out")
def test_places_at_addresses_that_cannot_be_read_are_a_line(layouts):
    layouts.rm("/run/table/all/0.png")
    with refused("^memory:/run/table/places.csv: found 1 of 6 images missing.*is all/0.png"):
        read_places("memory://run/table", min_images=2)
    found = read_places("memory://run/table", min_images=2, on_bad_image="skip")
    assert found.image_counts.tolist() == [3, 2]  # the first is of b
    layouts.pipe("/run/folders/a.png", b"x")
    with refused("^memory://run/folders: found a.png, p0/, p1/, p2/, expected the layout"):
        read_places("memory://run/folders", min_images=2)
    with refused("^memory://run/none: found no such folder, expected the layout"):
        read_places("memory://run/none")
    with refused("^http://h/a: found a user or a query"):
        read_places("http://h/a?key=1")


@pytest.mark.slow
def test_s3_in_a_server_of_moto(pictures, tmp_path, monkeypatch):
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "me")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "pa55")
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    try:
        files = fsspec.filesystem("s3")
        files.mkdir("frames-of-a-robot")
        for name, data in pictures.items():
            files.pipe(f"frames-of-a-robot/run/{name}", data)
        for given in ("s3://frames-of-a-robot/run", "s3://frames-of-a-robot/run/**/*.png"):
            source = open_source(given)
            assert source.names == NAMES
            for path, name in zip(source.paths, NAMES, strict=True):
                assert size_of(path) == len(pictures[name])
                np.testing.assert_array_equal(read_image(path), read_image(tmp_path / name))
        batches = image_batches(source.paths, image_size=(14, 14), batch_size=2)
        assert sum(int(batch.valid.sum()) for batch in batches) == len(NAMES)
        with refused("^s3://frames-of-a-robot/gone.png: cannot be read: found no such file"):
            read_image("s3://frames-of-a-robot/gone.png")
        write_layouts(tmp_path / "layouts")
        files.put(str(tmp_path / "layouts"), "frames-of-a-robot/layouts", recursive=True)
        for name in ("city", "folders", "table"):
            ours, theirs = (
                read_places(f"{at}/{name}", min_images=2)
                for at in ("s3://frames-of-a-robot/layouts", tmp_path / "layouts")
            )
            assert same_places(ours, theirs)
            data = FileCache(tmp_path / "cache", 2**30).read(ours.path(0))
            assert data == theirs.path(0).read_bytes()
        with refused("^s3://another-bucket-of-a-robot/run: found no folder"):
            open_source("s3://another-bucket-of-a-robot/run")
    finally:
        server.stop()
