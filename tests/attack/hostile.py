"""Give commands what a stranger made: links, code, bombs and names; watch a folder of the user.

    python -m tests.attack.hostile --out rows.json [--only GROUP ...]

The folder `outside` has files that links and names lead to. A try fails if any process opens,
changes or makes something in it, if code of the input runs, if memory grows by more than 2 GB, or
if the command ends in another way than with its result or one line.
"""

import ctypes
import functools
import io
import itertools
import json
import os
import pathlib
import pickle
import shutil
import struct
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import cv2
import numpy as np

from crisalad_jax.utils.checksums import checksummed_json
from tests.attack import inputs
from tests.attack.inputs import Make, base, containing, put, with_file, with_more
from tests.attack.world import (
    HUNG,
    Attack,
    Bench,
    Done,
    Row,
    World,
    carry_out,
    part_of,
    picture_bytes,
    run,
)

PROMISE = (
    "its result, or exit code 2 and one line without a traceback; nothing outside of the folder is "
    "opened or changed, no code of it runs, memory grows by less than 2 GB"
)
LIMIT, MEMORY = 120.0, 2**31
LOCK = ".crisalad-lock"


class Try(NamedTuple):
    """What a stranger made, and the command that reads it."""

    group: str
    words: str
    make: Make
    reads: bool = False
    """Whether the command may open what a link leads to, as of a data set."""


# ---- Links in folders that are written to ----

PLACES: Mapping[tuple[str, str, str], str] = {
    ("index", "--out", "map"): "segments segments/0000000000.npy segments/0000000000.json map.json "
    "approximate calibration.json added added/a",
    ("query", "--map", "map"): "segments segments/0000000000.npy segments/0000000000.json map.json "
    "approximate calibration.json added",
    ("info", "--map", "map"): "segments segments/0000000000.npy segments/0000000000.json map.json",
    ("train", "--out", "run"): "state best tensorboard metrics.jsonl last.safetensors config.json",
    ("compare", "--out", "comparison"): "gem gem/seed-0 config.json table.md",
}
"""Names in a folder that a command goes on with, by its verb, its flag and the whole folder."""
WRITERS: Mapping[str, tuple[str, str]] = {
    "train": ("--out", ""), "index": ("--out", ""), "compare": ("--out", ""),
    "demo": ("--out", ""), "extract": ("--out", "d.npy.partial"), "query": ("--map", "map"),
    "evaluate": ("--out", ""),
}  # fmt: skip
"""Where the lock of a new folder is; of `query`, which writes none, in the map that it reads."""
TARGETS = {
    "extract": ("--out d.npy", "--out d.h5", "--pairs pairs.txt"),
    "query": ("--json answers.json", "--gallery gallery.png"),
    "pca": ("--out pca.safetensors",),
    "info": ("--json info.json",),
    "convert": ("DST public.pth",),
    "evaluate": ("--json table.json", "--out pictures/config.json", "--report report/index.html"),
    "vocabulary": ("--out v.safetensors",),
}
"""Files that a command replaces, whatever name of another file a link gave them."""


def _link(how: str, link: pathlib.Path, outside: pathlib.Path) -> None:
    """Put a link to something outside in place of what is there, which moves outside."""
    link.parent.mkdir(parents=True, exist_ok=True)
    target = outside / f"moved-{link.name}"
    if link.exists():
        link.rename(target)
    elif how == "soft folder":
        target.mkdir()
        (target / "0000000000.npy").write_bytes(b"mine")
    elif how != "dangling":
        target.write_text("mine")
    (os.link if how == "hard" else os.symlink)(target, link)


def _in_folder(
    verb: str, flag: str, whole: str, name: str, how: str, world: World, bad: pathlib.Path
) -> list[str]:
    folder = bad / "foreign"
    if whole and "." not in whole:
        shutil.copytree(world.path(whole), folder)
    given = base(verb, world, bad)
    _link(how, folder / name, bad / "outside")
    return put(given, flag, str(folder / "d.npy" if verb == "extract" else folder))


def links() -> Iterator[Try]:
    """Put links into folders that commands write to, in place of locks, folders and files."""
    for (verb, flag, whole), names in PLACES.items():
        for name in names.split():
            how = "soft" if "." in name else "soft folder"
            make = functools.partial(_in_folder, verb, flag, whole, name, how)
            yield Try("links: folders", f"{verb}: {name} of {whole}", make)
        for how in ("soft", "hard", "dangling"):
            make = functools.partial(_in_folder, verb, flag, whole, LOCK, how)
            yield Try("links: locks", f"{verb}: {how}, {whole}", make)
    for (verb, (flag, whole)), how in itertools.product(
        WRITERS.items(), ("soft", "hard", "dangling")
    ):
        name = f"{whole}/{LOCK}" if verb == "extract" else LOCK
        make = functools.partial(_in_folder, verb, flag, whole, name, how)
        yield Try("links: locks", f"{verb}: {how}, a new folder", make)
    for verb, flag, name in (
        ("extract", "--out", "d.npy.partial"),
        ("demo", "--out", "run"), ("demo", "--out", "city"), ("train", "--out", "state"),
        ("train", "--out", "best"), ("index", "--out", "segments"),
        ("compare", "--out", "gem"),
    ):  # fmt: skip
        make = functools.partial(_in_folder, verb, flag, "", name, "soft folder")
        yield Try("links: folders", f"{verb}: {name}, a new folder", make)
    for verb, all_ in TARGETS.items():
        for target, how in itertools.product(all_, ("soft", "hard")):
            flag, name = target.split()

            def replace(
                world: World, bad: pathlib.Path, verb=verb, flag=flag, name=name, how=how
            ) -> list[str]:
                _link(how, bad / "foreign" / name, bad / "outside")
                value = bad / "foreign" / (name.partition("/")[0] if "/" in name else name)
                return put(base(verb, world, bad), flag, str(value))

            yield Try("links: targets", f"{verb} {target}: {how}", replace)


# ---- Code ----


class _Calls:
    def __init__(self, module: str, name: str, *args: Any) -> None:
        self._what = module, name, args


MARK = "touch {}/ran"
CALLS: Mapping[str, tuple[str, str]] = {
    "os.system": ("os", "system"), "posix.system": ("posix", "system"),
    "exec": ("builtins", "exec"), "eval": ("builtins", "eval"),
    "subprocess": ("subprocess", "getoutput"), "import": ("importlib", "import_module"),
    "runpy": ("runpy", "run_path"), "dots": ("numpy.core.multiarray", "os.system"),
    "torch's loader": ("torch", "load"), "ctypes": ("ctypes", "CDLL"), "open": ("io", "open"),
    "getattr": ("builtins", "getattr"), "our own command line": ("crisalad_jax.cli", "main"),
    "numpy's loader": ("numpy", "load"),
}  # fmt: skip


def _pickle(kind: str, form: str, outside: pathlib.Path) -> bytes:
    """Write a pickle that calls a function by one of several opcodes."""
    module, name = CALLS[kind]
    mark = f"{outside}/ran"
    args: Any = {
        "exec": (f"open({mark!r}, 'w')",), "eval": (f"open({mark!r}, 'w')",),
        "open": (mark, "w"), "runpy": (f"{outside}/evil.py",), "import": ("antigravity",),
        "our own command line": (["info", "--preset", "tiny", "--json", f"{mark}.json"],),
    }.get(kind, (f"touch {mark}",))  # fmt: skip
    given = pickle.dumps(args, 2)[2:-1]  # a tuple on the stack
    called = f"c{module}\n{name}\n".encode()
    if form == "reduce":
        return b"\x80\x02" + called + given + b"R."
    if form == "stack":
        words = b"".join(b"\x8c" + bytes([len(each)]) + each.encode() for each in (module, name))
        return b"\x80\x04" + words + b"\x93" + given + b"R."
    if form == "inst":
        one = pickle.dumps(args[0], 0)[:-1]
        return b"(" + one + f"i{module}\n{name}\n.".encode()
    if form == "newobj":
        return b"\x80\x02" + called + given + b"\x81."
    state = b"}X\x04\x00\x00\x00mark" + called + given + b"Rs"  # a dictionary with the result
    return b"\x80\x02" + state + b"."


FORMS = ("reduce", "stack", "inst", "newobj", "within")


def _torch_zip(data: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("archive/data.pkl", data)
        archive.writestr("archive/version", "3\n")
        archive.writestr("archive/byteorder", "little")
        archive.writestr("../../outside/ran", "written")
    return file.getvalue()


def _npy(data: bytes) -> bytes:
    return inputs._npy(inputs._header("'|O'", shape="(2, 2)"), data)


def code() -> Iterator[Try]:
    """Write code into checkpoints and arrays, by each way that a pickle has to call it."""
    for kind, form in itertools.product(CALLS, FORMS):

        def make(world: World, bad: pathlib.Path, kind=kind, form=form, zipped=False) -> list[str]:
            data = _pickle(kind, form, bad / "outside")
            containing(_torch_zip(data) if zipped else data)(bad / "bad.pth")
            return ["convert", str(bad / "bad.pth"), str(bad / "out" / "x.safetensors")]

        def evaluate(world: World, bad: pathlib.Path, kind=kind, form=form) -> list[str]:
            for side, number in itertools.product(("ref", "query"), "01"):
                containing(picture_bytes(".jpg"))(bad / "set" / side / f"{number}.jpg")
            data = _npy(_pickle(kind, form, bad / "outside"))
            containing(data)(bad / "set" / "ground_truth_new.npy")
            return put(base("evaluate", world, bad), "--data", str(bad / "set"))

        yield Try("code: torch", f"{kind} by {form}", make)
        if form in ("reduce", "stack"):
            zipped = functools.partial(make, zipped=True)
            yield Try("code: torch", f"{kind} by {form}, zipped", zipped)
            yield Try("code: object arrays", f"{kind} by {form}", evaluate)
    for flag, name, verb in (
        ("--descriptors", "d.npy", "pca"), ("--database", "d.npy", "extract"),
        ("--data", "x_gt.npy", "evaluate"), ("--pca", "pca.npy", "extract"),
    ):  # fmt: skip
        for form in FORMS:

            def array(world: World, bad: pathlib.Path, flag=flag, name=name, verb=verb, form=form):
                data = _npy(_pickle("os.system", form, bad / "outside"))
                containing(data)(bad / name)
                return put(base(verb, world, bad), flag, str(bad / name))

            yield Try("code: object arrays", f"{verb} {flag}: {form}", array)


# ---- Names of plug-ins ----

PLUGINS = (
    *(
        "evil",
        "evil.py",
        "../outside/evil.py",
        "./evil",
        "os; import evil",
        "\x1b[31m\n",
        "evil:run",
    ),
    *("x" * 10**6, "http://127.0.0.1/evil.py", "/proc/self/mem", "..", "", "evil\0", "__main__"),
)
"""What a file says that its part was registered by: it is named to the user, and never loaded."""
ODD = ("\x1b[31m", "a\nb", "..", ".", "/", "x" * 5000, "os.path.", "..os", "nul\0", "a:b", "-", "~")
"""Values of --plugin."""


def plugins() -> Iterator[Try]:
    """Name plug-ins in configurations, weights and maps, and odd ones to --plugin."""
    for name in PLUGINS:
        part = {"part": "evil-part", "plugin": name}

        def recipe(world: World, bad: pathlib.Path, part=part) -> list[str]:
            value = json.loads(world.path("recipe.json").read_text())
            value.pop("checksum", None)
            value["model"]["aggregator"] = part
            (bad / "recipe.json").write_text(json.dumps(value))
            return put(base("train", world, bad), "--config", str(bad / "recipe.json"))

        def a_map(world: World, bad: pathlib.Path, part=part) -> list[str]:
            shutil.copytree(world.path("map"), bad / "map")
            value = json.loads((bad / "map" / "map.json").read_text())
            value["config"]["aggregator"] = part
            del value["checksum"]
            (bad / "map" / "map.json").write_bytes(checksummed_json(value))
            return put(base("query", world, bad), "--map", str(bad / "map"))

        def weights(world: World, bad: pathlib.Path, part=part) -> list[str]:
            data = world.path("weights.safetensors").read_bytes()
            end = 8 + int.from_bytes(data[:8], "little")
            header = json.loads(data[8:end])
            form, text = next(iter(header["__metadata__"].items()))
            value = json.loads(text)
            value["config"]["aggregator"] = part
            header["__metadata__"] = {form: json.dumps(value)}
            head = json.dumps(header).encode()
            (bad / "w.safetensors").write_bytes(inputs._safetensors(head, data[end:]))
            return ["info", "--weights", str(bad / "w.safetensors")]

        for words, make in (("recipe", recipe), ("map", a_map), ("weights", weights)):
            yield Try("names of plug-ins", f"{words}: {name[:30]!r}", make)
    for name in ODD:
        yield Try("names of plug-ins", f"{name[:30]!r}", with_more("info", "--plugin", name))
    for kind in ("a pipe", "a link to itself", "3 GB of nothing", "random bytes", "a folder"):
        make = with_file("info", "--plugin", "part.py", inputs.FILES[kind])
        yield Try("names of plug-ins", kind, make)


# ---- Sets: tables, videos, archives ----


def _long(start: str, path: pathlib.Path) -> None:
    """Write a file with one line of nearly 1 GB, which takes no room on the disk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        file.write(start.encode())
        file.truncate(2**30 - 1)


LONG = ("", "name,lat,lon\n", "\U0001f600", 'name,lat,lon\n"', "[1, ", '{"checksum": "')
TABLES = {
    "index": ("--positions", "p.csv"), "extract": ("--images", "list.txt"),
    "train": ("--config", "recipe.json"), "query": ("IMAGE", "list.csv"),
}  # fmt: skip


def tables() -> Iterator[Try]:
    """Give tables, lists and configurations of a line of 1 GB."""
    for (verb, (flag, name)), start in itertools.product(TABLES.items(), LONG):
        make = with_file(verb, flag, name, functools.partial(_long, start))
        yield Try("tables of a line of 1 GB", f"{verb} {flag}: {start!r}", make)
    for name in ("set/ground_truth.csv", "set/x_gt.npy", "set/queries.txt"):
        make = with_file("evaluate", "--data", name, functools.partial(_long, ""), "set")
        yield Try("tables of a line of 1 GB", name, make)


def _playlists(outside: pathlib.Path) -> Mapping[str, str]:
    film = outside / "film.mp4"
    head = "#EXTM3U\n#EXT-X-TARGETDURATION:2\n#EXTINF:2,\n"
    return {
        "HLS": f"{head}file://{film}\n#EXT-X-ENDLIST\n", "HLS, a path": f"{head}{film}\n",
        "a list": f"ffconcat version 1.0\nfile '{film}'\n",
        "a list, below": "ffconcat version 1.0\nfile '../outside/film.mp4'\n",
        "a list, file:": f"ffconcat version 1.0\nfile 'file:{film}'\n",
        "DASH": f'<?xml version="1.0"?><MPD><Period><AdaptationSet><Representation id="1">'
        f"<BaseURL>file://{film}</BaseURL></Representation></AdaptationSet></Period></MPD>",
        "SDP": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\n"
        "m=video 5004 RTP/AVP 96\na=rtpmap:96 H264/90000\n",
        "Matroska's magic": "\x1aE\u07a3", "an AVI of nothing": "RIFF\xff\xff\xff\x7fAVI LIST",
    }  # fmt: skip


def _film(change: Callable[[bytearray], Any], path: pathlib.Path) -> None:
    """Write a video with other bytes in its header."""
    whole = path.with_name("whole.avi")
    path.parent.mkdir(parents=True, exist_ok=True)
    film = cv2.VideoWriter(str(whole), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for shade in range(5):
        film.write(np.full((48, 64, 3), 40 * shade, np.uint8))
    film.release()
    data = bytearray(whole.read_bytes())
    whole.unlink()
    change(data)
    path.write_bytes(data)


def _at(offset: int, value: int) -> Callable[[bytearray], Any]:
    return lambda data: data.__setitem__(slice(offset, offset + 4), struct.pack("<I", value))


FILMS: Mapping[str, Callable[[bytearray], Any]] = {
    "2**31 frames": _at(48, 2**31 - 1), "no microseconds a frame": _at(32, 0),
    "2**31 microseconds a frame": _at(32, 2**31 - 1), "60,000 wide": _at(64, 60_000),
    "2**31 wide": _at(64, 2**31 - 1), "cut short": lambda data: data.__delitem__(slice(3000, None)),
}  # fmt: skip


def videos() -> Iterator[Try]:
    """Give videos that lead to other files, or that claim any size or length."""
    for verb, flag in (("extract", "--images"), ("query", "IMAGE")):
        for kind in _playlists(pathlib.Path()):

            def make(world: World, bad: pathlib.Path, verb=verb, flag=flag, kind=kind) -> list[str]:
                path = bad / "videos" / "walk.mp4"
                containing(_playlists(bad / "outside")[kind])(path)
                return put(base(verb, world, bad), flag, str(path))

            yield Try("videos", f"{verb}: {kind}", make)
        for kind, change in FILMS.items():
            film = functools.partial(_film, change)
            yield Try("videos", f"{verb}: {kind}", with_file(verb, flag, "walk.avi", film))


def _element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def _mat(count: int, elements: int = 1, name: bytes = b"dbStruct", kind: int = 9) -> bytes:
    """Write a MATLAB file of version 5 whose arrays have so many bytes, compressed."""
    parts = []
    for _ in range(elements):
        flags = _element(6, struct.pack("<II", kind, 0))
        head = flags + _element(5, struct.pack("<ii", 1, count)) + _element(1, name)
        head += struct.pack("<II", 2, count)
        packed = zlib.compressobj(9)
        body = packed.compress(struct.pack("<II", 14, len(head) + count) + head)
        zeros = bytes(2**20)
        body += b"".join(packed.compress(zeros) for _ in range(count >> 20)) + packed.flush()
        parts.append(struct.pack("<II", 15, len(body)) + body)
    start = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<HH", 0x0100, 0x4D49)
    return start + b"".join(parts)


MATS: Mapping[str, Callable[[], bytes]] = {
    "1.9 GB in 2 MB": lambda: _mat(1900 << 20), "12 arrays of 200 MB": lambda: _mat(200 << 20, 12),
    "text of 400 MB": lambda: _mat(400 << 20, kind=4), "cells": lambda: _mat(64 << 20, kind=1),
    "a function": lambda: _mat(1 << 20, kind=16), "an object": lambda: _mat(1 << 20, kind=17),
    "tags": lambda: _mat(0)[:128] + b"\x0e\0\0\0\x01\0\0\0" * 10**5, "nothing": lambda: _mat(0),
    "a lie of 4 GB": lambda: _mat(0)[:128] + struct.pack("<II", 14, 2**32 - 1) + bytes(64),
}  # fmt: skip


def archives() -> Iterator[Try]:
    """Give MATLAB files and archives that unpack to more than they are."""
    for kind, data in MATS.items():
        for verb, flag in (("evaluate", "--data"), ("convert", "SRC")):
            if verb == "convert" and kind.startswith("text"):
                continue  # scipy takes five bytes for a letter; weights may have 1 GB
            make = with_file(verb, flag, "bad.mat", containing(data))
            yield Try("archives", f"{verb}: MATLAB, {kind}", make)
    for kind, write in {"zip": inputs._bomb, "torch": inputs._torch_bomb}.items():
        for verb, flag in (("convert", "SRC"), ("info", "--weights"), ("pca", "--descriptors")):
            suffix = {"convert": ".pth", "info": ".safetensors", "pca": ".npy"}[verb]
            make = with_file(verb, flag, f"bad{suffix}", write)
            yield Try("archives", f"{verb}: {kind}", make)


# ---- Exported programs ----


def _onnx(key: str, value: str, world: World, bad: pathlib.Path) -> Any:
    """Change where a program says that its weights are, with the right checksums around it."""
    import onnx

    shutil.copytree(world.path("onnx"), bad / "onnx")
    model = onnx.load(str(bad / "onnx" / "describe.onnx"), load_external_data=False)
    changed = 0
    for each in model.graph.initializer:
        for entry in each.external_data:
            if entry.key == key:
                entry.value, changed = value.replace("OUTSIDE", str(bad / "outside")), changed + 1
    assert changed, key
    data = model.SerializeToString()
    (bad / "onnx" / "describe.onnx").write_bytes(data)
    manifest = json.loads((bad / "onnx" / "manifest.json").read_text())
    import hashlib

    manifest["program"] |= {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    del manifest["checksum"]
    (bad / "onnx" / "manifest.json").write_bytes(checksummed_json(manifest))


ONNX = (
    ("location", "../outside/thesis.txt"), ("location", "OUTSIDE/thesis.txt"),
    ("location", "file://OUTSIDE/thesis.txt"), ("location", "/dev/zero"), ("location", ""),
    ("location", "x\x1b[31m"), ("location", "describe.onnx"), ("offset", "99999999999"),
    ("length", "9" * 15), ("offset", "-1"),
)  # fmt: skip


def programs() -> Iterator[Try]:
    """Give exported programs whose data are elsewhere."""
    for engine, (key, value) in itertools.product(("onnxruntime", "openvino"), ONNX):

        def make(world: World, bad: pathlib.Path, engine=engine, key=key, value=value) -> list[str]:
            _onnx(key, value, world, bad)
            given = put(base("extract", world, bad), "--weights", str(bad / "onnx"))
            return [*given, "--runtime", engine]

        yield Try("exported programs", f"{engine}: {key} {value!r}", make)
    for engine, name in itertools.product(("onnxruntime", "openvino"), ("program", "weights")):

        def moved(world: World, bad: pathlib.Path, engine=engine, name=name) -> list[str]:
            shutil.copytree(world.path("onnx"), bad / "onnx")
            manifest = json.loads((bad / "onnx" / "manifest.json").read_text())
            file = manifest[name]["file"]
            (bad / "onnx" / file).rename(bad / "outside" / file)
            manifest[name]["file"] = f"../outside/{file}"
            del manifest["checksum"]
            (bad / "onnx" / "manifest.json").write_bytes(checksummed_json(manifest))
            given = put(base("extract", world, bad), "--weights", str(bad / "onnx"))
            return [*given, "--runtime", engine]

        yield Try("exported programs", f"{engine}: {name} is outside", moved)


# ---- One try ----

_OPEN, _CHANGES = 0x1 | 0x20, 0x2 | 0x4 | 0x40 | 0x80 | 0x100 | 0x200 | 0x400
"""Events of inotify: accessed or opened; modified, attributes, moved, made, deleted."""


class Watch:
    """What any process does in a folder."""

    def __init__(self, folder: pathlib.Path, *, reads: bool) -> None:
        """Begin to watch; where it is allowed, without reads."""
        libc = ctypes.CDLL(None, use_errno=True)
        self._file = libc.inotify_init1(os.O_NONBLOCK)
        mask = _CHANGES | (0 if reads else _OPEN)
        assert libc.inotify_add_watch(self._file, bytes(folder), mask) >= 0

    def seen(self) -> list[str]:
        """Return the names of what was touched, and stop."""
        try:
            data = os.read(self._file, 2**16)
        except BlockingIOError:
            data = b""
        os.close(self._file)
        names = []
        while data:
            mask, length = (
                struct.unpack_from("II", data, 4)[0],
                struct.unpack_from("I", data, 12)[0],
            )
            name = data[16 : 16 + length].rstrip(b"\0").decode()
            names.append(f"{mask & 0xFFF:#x} {name}")
            data = data[16 + length :]
        return sorted(set(names))


def _outside(folder: pathlib.Path) -> None:
    """Make the user's own files."""
    folder.mkdir()
    (folder / "thesis.txt").write_text("mine" * 100)
    (folder / "evil.py").write_text(f"open({str(folder / 'ran')!r}, 'w')\n")
    film = cv2.VideoWriter(str(folder / "film.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, (64, 48))
    for _ in range(5):
        film.write(np.zeros((48, 64, 3), np.uint8))
    film.release()


def _state(folder: pathlib.Path) -> dict[str, Any]:
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return {str(path): path.read_bytes() for path in files}


def attempt(each: Try, world: World, folder: pathlib.Path) -> str | None:
    """Carry out a try in a new folder; return what is wrong."""
    outside = folder / "outside"
    (folder / "out").mkdir(parents=True)
    _outside(outside)
    (folder / "evil.py").write_text(f"open({str(outside / 'ran')!r}, 'w')\n")
    try:
        given = each.make(world, folder)
        before = _state(outside)
        watch = Watch(outside, reads=each.reads)
        done = run(given, cwd=folder, limit=LIMIT)
        seen = watch.seen()
        return judge(done, seen, _state(outside) != before)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def judge(done: Done, seen: list[str], changed: bool) -> str | None:
    """Return what is wrong with how a command ended."""
    # Lines of FFmpeg and libpng, which have no switch for them.
    lines = [line for line in done.err.splitlines() if line.startswith("crisalad: ")]
    said = done._replace(err="\n".join(lines))
    wrong = [f"touched {seen[:4]}"] if seen else []
    wrong += ["changed a file outside"] if changed else []
    if done.code == HUNG:
        wrong.append("hung")
    elif done.code and not said.told_in_one_line():
        wrong.append(f"code {done.code}")
    if "Traceback" in done.err:
        wrong.append("a traceback")
    if "\x1b" in done.out + done.err:
        wrong.append("escape sequences")
    if done.peak_bytes > MEMORY:
        wrong.append(f"{done.peak_bytes / 2**30:.1f} GB")
    return f"{'; '.join(wrong)}: {done.err[-400:]!r}" if wrong else None


def tries() -> list[Try]:
    """List all tries."""
    makers = (links, code, plugins, tables, videos, archives, programs)
    return [each for maker in makers for each in maker()]


def _group(each: Try) -> str:
    return each.group.partition(":")[0]


def attack(chosen: Callable[[Bench, float], list[Try]], bench: Bench, scale: float) -> list[Row]:
    """Carry out tries, and return their rows."""
    import torch  # noqa: F401  (once, before the forks)

    rows: dict[str, Row] = {}
    for number, each in enumerate(chosen(bench, scale)):
        row = rows.setdefault(each.group, Row(f"hostile {each.group}", PROMISE))
        wrong = attempt(each, bench.world, bench.folder / "hostile" / str(number))
        row.note(wrong is None, f"{each.words}: {wrong}")
    return list(rows.values())


def _all_of(group: str, bench: Bench, scale: float) -> list[Try]:
    return [each for each in tries() if _group(each) == group]


SAMPLE, SAMPLED = "a sample", ("links: locks", "code: torch", "names of plug-ins", "videos")


def _sample(bench: Bench, scale: float) -> list[Try]:
    quick = [each for each in tries() if each.group in SAMPLED]
    return bench.random.sample(quick, part_of(100, scale, least=6))


def attacks() -> dict[str, Attack]:
    """Return an attack for each group, and a sample."""
    groups = dict.fromkeys(map(_group, tries()))
    named: dict[str, Any] = {group: functools.partial(_all_of, group) for group in groups}
    chosen = {SAMPLE: _sample, **named}
    return {name: functools.partial(attack, which) for name, which in chosen.items()}


if __name__ == "__main__":
    sys.exit(carry_out(attacks(), __doc__, optional=[SAMPLE], keep=False))
