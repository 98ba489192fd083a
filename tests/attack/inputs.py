"""Give every verb bad inputs: files, folders, numbers, names and settings, a process for each.

    python -m tests.attack.inputs --out rows.json [--seed 0] [--only GROUP ...]

A table says for each verb and argument what is bad about it. A group is what stands before the
colon of its rows; `a sample` is some of the quick ones.
"""

import csv
import functools
import io
import itertools
import json
import math
import os
import pathlib
import pickle
import random
import re
import shutil
import socket
import struct
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import h5py
import numpy as np

from crisalad_jax.utils.checksums import checksummed_json
from tests.attack.world import (
    HUNG,
    Attack,
    Bench,
    Done,
    Row,
    World,
    arguments,
    carry_out,
    files_in,
    part_of,
    picture_bytes,
    run,
    with_flag,
)
from tests.data.benchmarks import test_msls, test_netvlad

PROMISE = (
    "exit code 2 and one line that names the file or argument, without a traceback, within the "
    "limit of time, in less than 1.5 GB beyond the start; nothing is left in the folder of results"
)
HANGS = 60.0
"""Seconds until a command counts as hung."""
ABORTED = "ended by signal "
UNCAUGHT = (
    "none: where memory ends inside of XLA, BLAS or OpenMP, these abort the process in C++, before "
    "Python can say a line; counted here, and no failure"
)
MOST_MEMORY = 3 * 2**29
SPARSE = 3 * 2**30
Make = Callable[[World, pathlib.Path], list[str]]
"""Makes the bad input in a folder, and returns the command's arguments."""


class Case(NamedTuple):
    """A bad input."""

    attack: str
    """The kind, a row of the report."""
    words: str
    make: Make
    named: tuple[str, ...] = ()
    """The line names one of these; all pass where there is none."""
    fine: bool = False
    """Whether success is right too."""
    memory: int | None = None
    """Limit of the address space beyond the start."""
    check: Callable[[Done, pathlib.Path], str | None] = lambda done, folder: None
    """Returns what else is wrong."""


def base(verb: str, world: World, folder: pathlib.Path) -> list[str]:
    """Return a verb's good arguments, which write into `folder`/out."""
    return arguments("extract .npy" if verb == "extract" else verb, world, folder / "out")


def put(given: list[str], flag: str, *values: str) -> list[str]:
    """Give an argument other values, by its flag or its place."""
    verb = given[0]
    if flag in ("IMAGE", "SRC"):
        return [verb, *values, *given[2:]]
    if flag == "DST":
        return [*given[:2], *values, *given[3:]]
    if (verb, flag) == ("info", "--map"):
        return ["info", "--map", *values, "--json", given[-1]]
    if flag in ("--recipe", "--preset") and "--weights" in given:
        given = [*without(given, "--weights"), "--preset", "tiny"]
    if (verb, flag) == ("compare", "--rerank"):
        given = with_flag(given, "--methods", "patch-netvlad")
    return with_flag(given, flag, *values)


def without(given: list[str], flag: str) -> list[str]:
    """Leave out a flag and its value."""
    where = given.index(flag)
    return given[:where] + given[where + 2 :]


def with_values(verb: str, flag: str, *values: str) -> Make:
    """Give a verb's argument other values."""
    return lambda world, bad: put(base(verb, world, bad), flag, *values)


def with_more(verb: str, *more: str) -> Make:
    """Give a verb more arguments than its good ones."""
    return lambda world, bad: [*base(verb, world, bad), *more]


Write = Callable[[pathlib.Path], Any]
"""Makes the bad file or folder at a path."""


def containing(data: bytes | str | Callable[[], bytes]) -> Write:
    """Write a file of these bytes, or of this text; a function makes them when they are needed."""

    def write(path: pathlib.Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        made = data() if callable(data) else data
        path.write_bytes(made.encode() if isinstance(made, str) else made)

    return write


def with_file(
    start: str | Make, flag: str, name: str, write: Write, value: str | None = None
) -> Make:
    """Make something bad, and give it to a flag.

    Args:
        start: a verb, or what makes its arguments.
        flag: a flag of it, or IMAGE, SRC or DST.
        name: of what `write` makes.
        write: makes it.
        value: what the flag gets, below the folder of the case; None is what was made.
    """

    def make(world: World, bad: pathlib.Path) -> list[str]:
        given = base(start, world, bad) if isinstance(start, str) else start(world, bad)
        write(bad / name)
        return put(given, flag, str(bad / (value or name)))

    return make


def with_changed(verb: str, flag: str, name: str, change: Write) -> Make:
    """Change a copy of a file or folder of the world, and give it to a verb's flag."""

    def make(world: World, bad: pathlib.Path) -> list[str]:
        whole = world.path(name)
        (shutil.copytree if whole.is_dir() else shutil.copy)(whole, bad / name)
        change(bad / name)
        return put(base(verb, world, bad), flag, str(bad / name))

    return make


# ---- Something else in place of a file or a folder ----


def _random_bytes(path: pathlib.Path) -> None:
    path.write_bytes(np.random.default_rng(0).bytes(4096))


def _sparse(path: pathlib.Path) -> None:
    with path.open("wb") as file:
        file.truncate(SPARSE)


def _socket(path: pathlib.Path) -> None:
    here = os.getcwd()
    os.chdir(path.parent)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(path.name)
    os.chdir(here)


def _write_zeros(archive: zipfile.ZipFile, name: str, megabytes: int) -> None:
    with archive.open(name, "w", force_zip64=True) as file:
        for _ in range(megabytes):
            file.write(bytes(2**20))


def _bomb(path: pathlib.Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        _write_zeros(archive, "archive/data.pkl", 2048)


def _torch_bomb(path: pathlib.Path) -> None:
    """Write a checkpoint of a tensor of zeros of 4 GB that takes 4 MB: compressed."""
    import torch

    plain = path.with_name("plain.pth")
    torch.save({"state_dict": {"a": torch.zeros(2**10)}}, plain)
    with zipfile.ZipFile(plain) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            if name.endswith("/data/0"):
                _write_zeros(new, name, 4096)
            else:
                new.writestr(name, old.read(name))
    plain.unlink()


def _huge_storage(path: pathlib.Path) -> None:
    import torch

    meta = torch.zeros(1).as_strided((2**20, 2**18), (0, 0))
    torch.save({"state_dict": {"cls_token": meta}}, path)


FILES: Mapping[str, Write] = {
    "no file": lambda path: None,
    "a folder": lambda path: path.mkdir(),
    "a pipe": os.mkfifo,
    "a socket": _socket,
    "a link to itself": lambda path: path.symlink_to(path.name),
    "/dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "/dev/stdin": lambda path: path.symlink_to("/dev/stdin"),
    "an empty file": lambda path: path.touch(),
    "random bytes": _random_bytes,
    "3 GB of nothing": _sparse,
    "JSON nested 200,000 deep": lambda path: path.write_text("[" * 200_000),
    "a zip bomb": _bomb,
    "a picture": lambda path: path.write_bytes(picture_bytes()),
    "a list in JSON": lambda path: path.write_text("[1, 2]"),
    "UTF-16": lambda path: path.write_text("name,lat,lon\na,1,2\n", encoding="utf-16"),
}
FOLDERS = ("no file", "a pipe", "a socket", "a link to itself", "/dev/zero", "random bytes")

FILE_ARGUMENTS = {
    "train": "--data places/, --config recipe.json, --weights model.safetensors, "
    "--backbone backbone.pth, --val town/, --plugin part.py",
    "evaluate": "--data town/, --data set.mat, --weights model.safetensors, --pca pca.safetensors",
    "extract": "--weights model.safetensors, --images pictures/, --database d.h5, "
    "--database d.npy, --pca pca.safetensors",
    "index": "--images pictures/, --positions positions.csv, --weights model.safetensors",
    "query": "IMAGE query.jpg, --map map/, --weights model.safetensors",
    "pca": "--descriptors d.npy",
    "convert": "SRC model.pth, SRC model.safetensors",
    "info": "--weights model.safetensors, --map map/",
    "export": "--weights model.safetensors",
    "vocabulary": "--images pictures/, --backbone backbone.pth",
    "compare": "--train places/, --test town/, --backbone backbone.safetensors",
    "ablate": "--train places/",
}
"""Arguments of each verb, with the name of the bad file; a folder is right in place of NAME/."""
RIGHT = {("--plugin", kind) for kind in ("an empty file", "a list in JSON")}  # right Python
RIGHT |= {("IMAGE", "a folder"), ("IMAGE", "a picture")}


def wrong_files() -> Iterator[Case]:
    """Put something else in place of each file and folder."""
    for verb, listed in FILE_ARGUMENTS.items():
        for flag, name in (argument.split() for argument in listed.split(", ")):
            words, is_folder = f"{verb} {flag} {name}", name.endswith("/")
            for kind in FOLDERS if is_folder else FILES:
                if (flag, kind) not in RIGHT:
                    make = with_file(verb, flag, name.rstrip("/"), FILES[kind])
                    yield Case(f"files: {kind}", words, make, (name.rstrip("/"), flag))
            for value in ("", "-", "x" * 300, "no\x1b[31mred\nline", "caf\udce9", "/dev/zero"):
                # Empty values are refused before flags are told apart.
                named = (flag, "argument", value[:20], "red", "caf", flag.lower())
                make = with_values(verb, flag, value)
                yield Case(f"names: {value[:12]!r}", f"{verb} {flag}", make, named)


# ---- Targets ----

TARGETS = {
    **{"evaluate": "--json --out --report", "extract": "--out", "convert": "DST"},
    **{"query": "--json --out --gallery", "info": "--json"},
    **dict.fromkeys(("train", "index", "pairs", "pca", "export", "vocabulary"), "--out"),
    **dict.fromkeys(("compare", "demo", "render"), "--out"),
}
SUFFIX = {
    ("extract", "--out"): ".npy",
    ("pairs", "--out"): ".txt",
    ("query", "--out"): ".csv",
    ("pca", "--out"): ".safetensors",
    ("convert", "DST"): ".pth",
    ("vocabulary", "--out"): ".safetensors",
    ("query", "--gallery"): ".png",
}


def wrong_targets() -> Iterator[Case]:
    """Let each verb write to where nothing can be written, or must not be."""
    targets = [(verb, flag) for verb, flags in TARGETS.items() for flag in flags.split()]
    for verb, flag in targets:
        suffix = SUFFIX.get((verb, flag), "")
        name = f"target{suffix}"
        ways: Mapping[str, tuple[str, str, Write]] = {
            "below a file": (f"{name}/x{suffix}", name, containing("a file")),
            "below a loop of links": (f"loop/{name}", "loop", FILES["a link to itself"]),
            "a pipe": (name, name, FILES["a pipe"]),
            "a socket": (name, name, FILES["a socket"]),
            "a link to a device": (name, name, FILES["/dev/zero"]),
            "a folder with files": (name, f"{name}/mine.txt", containing("mine")),
            "a name of 300 letters": ("x" * 300 + suffix, name, FILES["no file"]),
            "in /proc": (f"/proc/none/{name}", name, FILES["no file"]),
        }
        for kind, (value, made, write) in ways.items():
            # A folder of pictures or pages may hold others.
            if kind != "a folder with files" or verb != "evaluate" or flag == "--json":
                make = with_file(verb, flag, made, write, value)
                named = ("target", "xxx", "loop", "/proc", "mine")
                yield Case(f"targets: {kind}", f"{verb} {flag}", make, named)


# ---- Numbers and words ----

HUGE = "99999999999999999999"
VALUES: Mapping[str, tuple[str, ...]] = {
    "evaluate|extract|pca|vocabulary|demo|render|train --seed": (
        *("-1", HUGE, str(2**32), "1.5", "nan", "x", "0x10"),
    ),
    "train|evaluate|extract|index|info|export|vocabulary --image-size": (
        *("1400000014 1400000014", "0 0", "-14 -14", "13 14", "x 14", "14"),
    ),
    "compare|ablate --image-size": ("1400000014 1400000014", "0 0"),
    "evaluate|extract|index|query|info|vocabulary|compare --batch-size": (
        *("0", "-1", HUGE, "1e9", "x"),
    ),
    "evaluate|extract|index|query|train|compare --max-pixels": ("0", "-1", HUGE, "x", "1e3"),
    "extract --k": ("0", "-1", HUGE),
    "query --k": ("0", "-1"),
    "evaluate --seeds": ("0", "-1", "1e9", HUGE),
    "compare --seeds": ("0", "-1", "1e9"),
    "evaluate --radius": ("-1", "nan", "inf", "x", "1e400"),
    "evaluate --frames": ("-1", "3", HUGE),
    "evaluate --max-heading-difference": ("-1", "nan", "400", "x"),
    "evaluate --grouping": (",", "foo", "single/", "/", "single/foo/bar", "single,,"),
    "evaluate --rerank": ("x", ":", "patch-netvlad:0", "transvpr:-1", f"transvpr:{HUGE}"),
    "evaluate --split": ("x", "../test", "train"),
    "evaluate --layout": ("x", "netvlad", "salad", "msls"),
    "evaluate --queries": ("../../..", "/etc", "x"),
    "evaluate|info|compare --preset": ("x",),
    "evaluate --compute-dtype": ("float8",),
    "train --epochs": ("0", "-1", HUGE, "1e9", "x"),
    "train --places-per-batch|--images-per-place|--min-images": ("0", "-1", HUGE),
    "train --patience|--num-threads|--cache-gb": ("-1", "x"),
    "train --save-top-k": ("-1",),
    "train --optimiser.learning-rate": ("-1", "nan", "inf", "x"),
    "train --model.aggregator|--augmentation": ("x",),
    "train --model.backbone.heads": ("0", "3", "-1", HUGE),
    "train --model.backbone.dim": ("0", "-1", HUGE),
    "train --model.backbone.depth": ("0", "-1"),
    "train --trainable": ("x", "last-0-blocks,head", "last-99-blocks,head", "all,,", "head"),
    "train --cities": ("x", "../Aston"),
    "train --num-processes": ("2", "-1"),
    "train --recipe": ("x", "salad"),
    "compare --epochs": ("0", "-1", HUGE),
    "compare --methods": ("x", "gem,gem", ",", "../gem"),
    "compare --rerank": ("0", "-1"),
    "compare --weights": ("x", "gem=", "=x", "gem=/dev/zero"),
    "compare --grouping|--reference": ("x",),
    "compare --jobs": ("0", "-1", "x"),
    "ablate --rows": ("x", "step:x", ","),
    "ablate --row": ("x", ":", "x: epochs", "x: epochs=0", f"x: epochs={HUGE}", "x: x=1"),
    "pca --dim": ("0", "-1", HUGE, "7.5"),
    "pca --samples": ("0", "-1", "1"),
    "export --platforms": (",", "x", "cpu,x"),
    "export --batch-size": ("0", "-1", "x"),
    "export --grouping": ("x",),
    "info --trainable": ("x", "last-99-blocks,head"),
    "convert --format": ("x", "huggingface", "cricavpr"),
    "vocabulary --clusters": ("0", "-1", HUGE, "1000000000"),
    "vocabulary --max-images": ("0", "-1"),
    "vocabulary --aggregator": ("x", "gem"),
    "vocabulary --layer": ("3",),
    "index --store": ("x", "milvus", "milvus:", "../files"),
    "index --dtype": ("int8",),
    "render --scenes": ("0", "-1", "x"),
    "render --sceneries": ("x",),
    "render --repaint": ("-1", "nan", "inf", "1e6"),
    "render --varied": ("sun",),
}
"""Bad values, by the verbs and the flags to which each is given."""


def wrong_values() -> Iterator[Case]:
    """Give flags values that are out of range, or nothing of their kind."""
    for key, values in VALUES.items():
        verbs, flags = (part.split("|") for part in key.split())
        for verb, flag, value in itertools.product(verbs, flags, values):
            word = flag.strip("-").split(".")[-1]
            names = (word, word.replace("-", " "), word.replace("-", "_"), value, "aggregator")
            more = {
                "--split": ("train", "val"),
                "--layout": ("layout", ".mat", "town"),
                "--format": ("public.pth: found suffix",),
            }
            named = (*names, *more.get(flag, ()), flag)
            # The one that does no work of its own accepts any number of images.
            fine = (verb, flag, value) in (
                ("info", "--batch-size", HUGE),
                ("evaluate", "--queries", "../../.."),
            )
            make = with_values(verb, flag, *value.split())
            yield Case(f"values: {flag}", f"{verb} {value}", make, named, fine)


def wrong_flags() -> Iterator[Case]:
    """Give unknown flags, flags without a value or twice, and other commands."""
    for verb in ("train", "evaluate", "extract", "index", "query", "pca", "export", "convert",
                 "info", "compare", "demo", "vocabulary", "ablate"):  # fmt: skip
        for words, more in {
            "unknown": ["--frobnicate", "3"],
            "unknown with escapes": ["--fro\x1b[31mb\nnicate", "3"],
            "no value": ["--plugin"] if verb not in ("pca", "demo") else ["--seed"],
            "a word too many": ["one", "two", "three"],
            "a surrogate": ["--\udce9"],
        }.items():
            fine = (verb, words) == ("query", "a word too many")
            named = ("argument", "option", "one", "--", "no such", "plugin")
            make = with_more(verb, *more)
            yield Case("flags", f"{verb}: {words}", make, named, fine)
    for given in (["x"], ["--frobnicate"], [""], ["train"], ["\x1b[31m"], ["\udce9"]):
        yield Case("flags", f"{given}", lambda world, bad, given=given: list(given))
    # A flag given twice: the last one counts, or it is refused.
    for verb, flag, first, last in (("extract", "--seed", "1", "-1"), ("pca", "--dim", "3", "0")):
        words, make = f"{verb} {flag} twice", with_more(verb, flag, first, flag, last)
        yield Case("flags", words, make, (flag, flag.strip("-")))


# ---- What is in files ----


def _npy(header: bytes, body: bytes = bytes(96), version: bytes = b"\x01\x00") -> bytes:
    return b"\x93NUMPY" + version + struct.pack("<H", len(header)) + header + body


def _header(descr: str = "'<f4'", order: str = "False", shape: str = "(8, 3)") -> bytes:
    return f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}\n".encode()


NPY: Mapping[str, bytes] = {
    "a zip": b"PK\x03\x04" + bytes(200),
    "a pickle": pickle.dumps(np.zeros((8, 3), object)),
    "objects": _npy(_header("'|O'"), pickle.dumps([None] * 24)),
    "a huge shape": _npy(_header(shape="(1000000000, 1000000)")),
    "a shape beyond 64 bits": _npy(_header(shape=f"({2**63}, {2**63})")),
    "a shape below zero": _npy(_header(shape="(-8, 3)")),
    "a shape of nothing": _npy(_header(shape="()")),
    "a shape of words": _npy(_header(shape="('a', 3)")),
    "columns, huge": _npy(_header(order="True", shape="(1000000000, 1000)")),
    "version 9": _npy(_header(), version=b"\x09\x00"),
    "version 0": _npy(_header(), version=b"\x00\x00"),
    "no header": _npy(b""),
    "a header of code": _npy(b"__import__('os').system('touch /tmp/crisalad-pwned')\n"),
    "a deep header": _npy(b"(" * 60000),
    "fields": _npy(_header("[('a', '<f4'), ('b', '<f4')]")),
    "times": _npy(_header("'<M8[s]'")),
    "text": _npy(_header("'<U4'")),
    "complex": _npy(_header("'<c16'")),
    "NaN": _npy(_header(), np.full((8, 3), np.nan, np.float32).tobytes()),
    "infinity": _npy(_header(), np.full((8, 3), np.inf, np.float32).tobytes()),
    "cut short": _npy(_header(), bytes(5)),
    "a header cut short": b"\x93NUMPY\x01\x00\xff\xff{",
    "zeros": _npy(_header()),
}


def _descriptors(data: bytes, names: bytes | None) -> Write:
    """Write descriptors, and the file of their names; None is a folder of that name."""

    def write(path: pathlib.Path) -> None:
        path.write_bytes(data)
        of_names = path.with_suffix(".names.txt")
        of_names.mkdir() if names is None else of_names.write_bytes(names)

    return write


def arrays() -> Iterator[Case]:
    """Damage .npy files."""
    for kind, data in NPY.items():
        make = with_file("pca", "--descriptors", "bad.npy", containing(data))
        yield Case("arrays: pca", kind, make, ("bad.npy", "dim"))
        write = _descriptors(data, b"".join(b"%d.jpg\n" % number for number in range(8)))
        make = with_file("extract", "--database", "bad.npy", write)
        yield Case("arrays: extract --database", kind, make, ("bad.npy",))
    whole = io.BytesIO()
    np.save(whole, np.eye(8, 584, dtype=np.float32))
    for kind, names in {
        "not UTF-8": b"caf\xe9.jpg\n" * 8,
        "a NUL": b"a\0b.jpg\n" * 8,
        "UTF-16": "a.jpg\n".encode("utf-16") * 8,
        "too few": b"a.jpg\n",
        "one line of 100 MB": b"x" * 10**8,
        "escapes": b"a\x1b[31m.jpg\n" * 7,
        "a folder": None,
    }.items():
        write = _descriptors(whole.getvalue(), names)
        make = with_file("extract", "--database", "bad.npy", write)
        yield Case("names of descriptors", kind, make, ("bad.n", "pairs"))


def _virtual(file: Any) -> None:
    layout = h5py.VirtualLayout((96,), "f4")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (96,))
    file.create_virtual_dataset(DATASET, layout)


def _deep_groups(file: Any) -> None:
    for _ in range(1000):
        file = file.create_group("g")
    file["global_descriptor"] = ONES


def _dataset(*shape: Any, **options: Any) -> Callable[[Any], Any]:
    return lambda file: file.create_dataset(DATASET, *shape, **options)


DATASET, ONES = "a/global_descriptor", np.ones(96, "f4")
H5: Mapping[str, Callable[[Any], Any] | Mapping[str, Any]] = {
    "a TB": _dataset((2**38,), "f4", chunks=(2**20,), compression=1),
    "external": _dataset((96,), "f4", external=[("/etc/passwd", 0, 384)]),
    "virtual": _virtual,
    "an external link": {"a": h5py.ExternalLink("/etc/passwd", "/x")},
    "links in a circle": {"a": h5py.SoftLink("/b"), "b": h5py.SoftLink("/a")},
    "a group in itself": lambda file: file.create_group("a").__setitem__("b", file["/"]),
    "groups 1,000 deep": _deep_groups,
    "a number": {DATASET: 1.0},
    "text": {DATASET: "text"},
    "fields": {DATASET: np.zeros(4, [("x", "f4")])},
    "a name with a line break": {"a\nb\x1b[31m/global_descriptor": ONES},
    "a name that is no UTF-8": {"cafe/global_descriptor": ONES},
    "lengths that differ": {DATASET: ONES, "b/global_descriptor": ONES[1:]},
    "empty": {DATASET: h5py.Empty("f4")},
    "integers": {DATASET: np.ones(96, "i4")},
    "nothing": {},
}
"""What is in a file, or what writes it."""


def _h5(kind: str, path: pathlib.Path) -> None:
    held = H5[kind]
    with h5py.File(path, "w") as file:
        held(file) if callable(held) else file.update(held)
    if kind == "a name that is no UTF-8":
        path.write_bytes(path.read_bytes().replace(b"cafe", b"caf\xe9"))


def hdf5(seed: int) -> Iterator[Case]:
    """Damage .h5 files, and let them claim what they do not hold."""
    generator = random.Random(seed)

    def case(attack: str, words: str, make: Make, *named: str) -> Case:
        """Return a case with a picture at which `extract` ends at the latest."""
        write = containing(b"\xff\xd8 no picture")
        make = with_file(make, "--images", "pictures/broken.jpg", write, "pictures")
        return Case(attack, words, make, named)

    def damage(place: float, change: bytes, cut: bool, path: pathlib.Path) -> None:
        data = bytearray(path.read_bytes())
        start = int(place * len(data))
        data[start : None if cut else start + 8] = b"" if cut else change
        path.write_bytes(data)

    for kind in H5:
        make = with_file("extract", "--database", "bad.h5", functools.partial(_h5, kind))
        yield case("HDF5", kind, make, "bad.h5")
    for number in range(48):
        place, change, cut = generator.random(), generator.randbytes(8), number % 6 == 0
        words = f"{'cut at' if cut else change.hex() + ' at'} {place:.4f}"
        write = functools.partial(damage, place, change, cut)
        make = with_changed("extract", "--database", "d.h5", write)
        yield case("HDF5: damaged", words, make, "d.h5", "broken.jpg")


def _leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield (*path, key)
            yield from _leaves(item, (*path, key))
    elif isinstance(value, list):
        for place, item in enumerate(value):
            yield from _leaves(item, (*path, place))


def _changed(value: Any, path: Sequence[Any], new: Any) -> Any:
    value = json.loads(json.dumps(value))
    at = value
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = new
    return value


STRANGE = (None, -1, 0, "x", [], {}, math.nan, math.inf, 10**30, True, [[[]]], "\x1b[31m", 1e-320)


def configurations(seed: int) -> Iterator[Case]:
    """Give configurations in JSON that are none, or absurd."""
    from crisalad_jax.config.io import to_plain
    from tests.conftest import MODEL, RECIPE

    texts = {
        "nested deep in objects": '{"a":' * 100_000,
        "a number": "3",
        "a text": '"text"',
        "null": "null",
        "NaN": "NaN",
        "Infinity": "-Infinity",
        "nothing": "{}",
        "a number of 5,000 digits": '{"epochs": ' + "9" * 5000 + "}",
        "cut short": '{"epochs": 3',
        "lone surrogates": '{"\\ud800": 1}',
        "escapes": '{"\\u001b[31m": 1}',
        "a byte order mark alone": "\ufeff",
        "a key twice": json.dumps(to_plain(RECIPE)).replace('"epochs"', '"epochs": 0, "epochs"'),
    }
    for kind, text in texts.items():
        make = with_file("train", "--config", "bad.json", containing(text))
        yield Case("configurations", kind, make, ("bad.json", "weights.safetensors"))
    generator = random.Random(seed)

    def strange(plain: Any, count: int) -> Iterator[tuple[str, Any]]:
        places = list(_leaves(plain))
        for _ in range(count):
            place, new = generator.choice(places), generator.choice(STRANGE)
            yield f"{'.'.join(map(str, place))} = {new!r}", _changed(plain, place, new)

    for words, changed in strange(to_plain(RECIPE), 60):
        make = with_file("train", "--config", "bad.json", containing(json.dumps(changed)))
        # A folder at which it ends at the latest.
        make = with_file(make, "--data", "no-places", FILES["a folder"])
        yield Case("configurations: strange values", words, make)
    model = to_plain(MODEL)
    attack, named = "weights: strange configurations", ("weights.safetensors",)
    for words, changed in strange(model, 40):
        yield Case(attack, words, _weights_of(changed), named, fine=True)
    for words, place, new in (
        ("a depth of 10**9", ("backbone", "depth"), 10**9),
        ("a dim of 10**9", ("backbone", "dim"), 10**9),
        ("images of 14 * 10**8", ("image_size",), [14 * 10**8, 14 * 10**8]),
        ("10**9 clusters", ("aggregator", "clusters"), 10**9),
        ("a feedforward of 10**12", ("cross_image", "feedforward"), 10**12),
    ):
        yield Case(attack, words, _weights_of(_changed(model, place, new)), named)


def _weights_of(config: Any) -> Make:
    """Make weights whose checksum is right and whose configuration is not."""

    def change(path: pathlib.Path) -> None:
        from crisalad_jax.checkpoints.safetensors_io import read_sealed, write_sealed
        from crisalad_jax.checkpoints.weights import FORMAT

        value, arrays = read_sealed(path, FORMAT, "weights")
        write_sealed(path, arrays, FORMAT, value | {"config": config})

    return with_changed("info", "--weights", "weights.safetensors", change)


def _safetensors(header: bytes, body: bytes = bytes(64), length: int | None = None) -> bytes:
    return (len(header) if length is None else length).to_bytes(8, "little") + header + body


def _tensor(dtype: str = "F32", shape: tuple = (16,), ends: tuple = (0, 64), name="a") -> bytes:
    entry = {"dtype": dtype, "shape": shape, "data_offsets": ends}
    return _safetensors(json.dumps({name: entry}).encode())


SAFETENSORS: Mapping[str, bytes] = {
    "a header of 2**62 bytes": _safetensors(b"{}", length=2**62),
    "a header of 90 MB, deep": _safetensors(b'{"a":' * 18_000_000),
    "a deep header": _safetensors(b'{"__metadata__":' + b"[" * 10**5),
    "metadata of numbers": _safetensors(b'{"__metadata__": {"crisalad": 3}}'),
    "no arrays": _safetensors(b"{}", b""),
    "offsets beyond": _tensor(shape=(4,), ends=(0, 999)),
    "offsets below zero": _tensor(shape=(4,), ends=(-4, 12)),
    "a shape of 2**62": _tensor(shape=(2**62, 4)),
    "an unknown type": _tensor("F3"),
    "a type of 8 bits": _tensor("F8_E4M3", shape=(64,)),
    "bytes that are no UTF-8": _safetensors(b'{"caf\xe9":{}}'),
    "a name with escapes": _tensor(name="\x1b[31m\n"),
    "metadata nested deep": _safetensors(
        json.dumps({"__metadata__": {"crisalad-jax 3": "[" * 10**5}}).encode(), b""
    ),
}


class _Call:
    def __reduce__(self) -> Any:
        return os.system, ("touch /tmp/crisalad-pwned",)


def weights() -> Iterator[Case]:
    """Damage weights and checkpoints."""

    def without_weights(world: World, bad: pathlib.Path) -> list[str]:
        return without(base("train", world, bad), "--weights")

    def convert(world: World, bad: pathlib.Path) -> list[str]:
        return ["convert", "SRC", str(bad / "out" / "x.safetensors")]

    for kind, data in SAFETENSORS.items():
        for start, verb, flag in (
            ("info", "info", "--weights"),
            ("convert", "convert", "SRC"),
            (without_weights, "train", "--backbone"),
        ):
            make = with_file(start, flag, "bad.safetensors", containing(data))
            yield Case("weights: safetensors", f"{verb}: {kind}", make, ("bad.safetensors",))
    makers: Mapping[str, Write] = {
        "a call": containing(pickle.dumps(_Call())),
        "nested deep": containing(b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b"."),
        "a bomb of 4 GB": _torch_bomb,
        "a tensor that claims 2**38 numbers": _huge_storage,
        "a list": containing(pickle.dumps([1, 2])),
        "a pickle that recurses": containing(b"\x80\x02]q\x00h\x00a."),
        "memo of 2**31": containing(b"\x80\x02Nr\xff\xff\xff\x7f."),
        "a long of 2**31 bytes": containing(b"\x80\x02\x8b\xff\xff\xff\x7f."),
        "numbers by text": containing(b"\x80\x02L" + b"9" * 10**6 + b"L\n."),
    }
    for kind, maker in makers.items():
        make = with_file(convert, "SRC", "bad.pth", maker)
        yield Case("weights: torch", kind, make, ("bad.pth",), check=_not_run)


def _not_run(done: Done, folder: pathlib.Path) -> str | None:
    pwned = pathlib.Path("/tmp/crisalad-pwned")
    if pwned.exists():
        pwned.unlink()
        return "code of the file was run"
    return None


def _png(width: int, height: int, rows: int) -> bytes:
    """Write a PNG of one bit a pixel that claims any size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    line = bytes(1 + -(-width // 8))
    packed = zlib.compressobj(9)
    body = b"".join(packed.compress(line) for _ in range(rows)) + packed.flush()
    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def _claiming(suffix: str, start: bytes, offset: int, claim: bytes) -> Callable[[], bytes]:
    """Write a small picture with other bytes in its header, at an offset from some of its own."""

    def picture() -> bytes:
        data = bytearray(picture_bytes(suffix))
        at = data.index(start) + offset
        data[at : at + len(claim)] = claim
        return bytes(data)

    return picture


def _tiff(width: int, height: int) -> bytes:
    tags = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1),
            (273, 4, 1, 8), (277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, 100)]  # fmt: skip
    entries = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    return (
        b"II*\0" + struct.pack("<I", 108) + bytes(100) + struct.pack("<H", 9) + entries + bytes(4)
    )


# Fourteen bits of each side, less one, behind a byte.
_WEBP = _claiming(".webp", b"VP8L", 9, b"\xff\xff\xff\x0f")
PICTURES: Mapping[str, Callable[[], bytes]] = {
    "a PNG of 40,000 x 40,000": lambda: _png(40_000, 40_000, 40_000),
    "a PNG of 2**31 - 1 squared": lambda: _png(2**31 - 1, 2**31 - 1, 0),
    "a PNG of no size": lambda: _png(0, 0, 0),
    "a PNG cut short": lambda: picture_bytes()[:-20],
    "a PNG without pixels": lambda: _png(100, 100, 0),
    "a JPEG of 65,535 x 65,535": _claiming(".jpg", b"\xff\xc0", 5, b"\xff" * 4),
    "a JPEG of no height": _claiming(".jpg", b"\xff\xc0", 5, bytes(2)),
    "a TIFF of 2**31": lambda: _tiff(2**31, 2**31),
    "a TIFF of 60,000 x 60,000": lambda: _tiff(60_000, 60_000),
    "a TIFF that points at itself": lambda: b"II*\0\x08\0\0\0" + b"\xff" * 64,
    "a WebP of 16,384 x 16,384": lambda: _WEBP()[:-4],  # whole, its one colour would be read
    "a BMP of 2**31": _claiming(".bmp", b"BM", 18, struct.pack("<ii", 2**31 - 1, 2**31 - 1)),
    "a BMP of -2**31": _claiming(".bmp", b"BM", 18, struct.pack("<ii", 9, -(2**31))),
    "text": lambda: b"<svg/>",
    "a GIF": lambda: b"GIF89a" + bytes(40),
}


def _linked(made: Mapping[str, str], folder: pathlib.Path) -> None:
    """Make a folder of pictures with links, and one picture at which it ends at the latest."""
    for name, target in made.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).symlink_to(target)
    (folder / "broken.jpg").write_bytes(b"broken")


def _printing(more: Sequence[str], world: World, bad: pathlib.Path) -> list[str]:
    """Let a query print its answers, or draw them."""
    more = [each.replace("OUT", str(bad / "out")) for each in more]
    return ["query", "IMAGE", "--map", str(world.path("map")), "--quiet", *more]


def pictures() -> Iterator[Case]:
    """Give pictures that are none, claim any size, or have names that terminals obey."""
    for kind, data in PICTURES.items():
        for verb, flag in (("extract", "--images"), ("index", "--images"), ("query", "IMAGE")):
            make = with_file(verb, flag, "pictures/bad.png", containing(data), "pictures")
            yield Case("pictures", f"{verb}: {kind}", make, ("bad.png",))
    # A link to the root would find pictures of all kinds.
    for kind, made in {
        "a folder that links to itself": {"a/b": "../a"},
        "two folders that link to each other": {"a/x": "../b", "b/y": "../a"},
    }.items():
        make = with_file("extract", "--images", "pictures", functools.partial(_linked, made))
        yield Case("pictures: links", kind, make, ("broken.jpg", "pictures"))
    names = {
        "escapes": "a\x1b[31mb.jpg", "a line break": "a\nb.jpg", "no UTF-8": "caf\udce9.jpg",
        "a bell and a carriage return": "a\x07\rb.jpg", "right to left": "a\u202eb.jpg",
    }  # fmt: skip
    attack = "pictures: names"
    for kind, name in names.items():
        path = f"pictures/{name}"
        for words, data in (("broken", b"broken"), ("whole", picture_bytes())):
            make = with_file("extract", "--images", path, containing(data), "pictures")
            yield Case(attack, f"extract: {kind}, {words}", make, fine=True)
            make = with_file("query", "IMAGE", path, containing(data))
            yield Case(attack, f"query: {kind}, {words}", make, fine=True)
        for more in (["--json", "-"], ["--gallery", "OUT/g.png"], []):
            start = functools.partial(_printing, more)
            make = with_file(start, "IMAGE", path, containing(picture_bytes()))
            yield Case(attack, f"query {more}: {kind}", make, fine=True)

    def others(folder: pathlib.Path) -> None:
        for name in ("a.heic", "b.HEIC", "c.gif"):
            containing(b"other")(folder / name)

    def told(done: Done, folder: pathlib.Path) -> str | None:
        return None if "heic" in done.err else "no word of the images that are not read"

    make = with_file("extract", "--images", "pictures", others)
    yield Case("pictures", "none but .heic", make, ("c.gif: found 5 bytes",), check=told)


POSITIONS: Mapping[str, bytes] = {
    "a NUL": b"name,lat,lon\nsub/0.jpg,1\x00,2\n",
    "a line of 50 MB": b"name,lat,lon\nsub/0.jpg," + b"1" * 5 * 10**7 + b",2\n",
    "UTF-16": "name,lat,lon\nsub/0.jpg,1,2\n".encode("utf-16"),
    "Latin-1": b"name,lat,lon\ncaf\xe9.jpg,1,2\n",
    "a latitude of 91": b"name,lat,lon\nsub/0.jpg,91,2\n",
    "a longitude of -181": b"name,lat,lon\nsub/0.jpg,1,-181\n",
    "NaN": b"name,lat,lon\nsub/0.jpg,nan,2\n",
    "1e400": b"name,east,north\nsub/0.jpg,1e400,2\n",
    "a metre of 1e300": b"name,east,north\nsub/0.jpg,1e300,2\n",
    "a decimal comma": b"name,lat,lon\nsub/0.jpg,1,5,2,5\n",
    "no header": b"sub/0.jpg,1,2\n",
    "nothing": b"",
    "too few fields": b"name,lat,lon\nsub/0.jpg,1\n",
    "a name twice": b"name,lat,lon\nsub/0.jpg,1,2\nsub/0.jpg,1,2\n",
    "a column twice": b"name,lat,lat,lon\nsub/0.jpg,1,2,3\n",
    "an open quote": b'name,lat,lon\n"sub/0.jpg,1,2\n' + b"x,1,2\n" * 30000,
    "other names": b"name,lat,lon\n../../etc/passwd,1,2\n",
    "escapes": b"name,lat,lon\n\x1b[31m,1,x\n",
    "carriage returns": b"name,lat,lon\rsub/0.jpg,x,2\r",
}


def tables() -> Iterator[Case]:
    """Damage tables of CSV."""
    for kind, data in POSITIONS.items():
        make = with_file("index", "--positions", "bad.csv", containing(data))
        yield Case("tables: positions", kind, make, ("bad.csv",))
    head = b"place_id,year,month,northdeg,city_id,lat,lon,panoid\n"
    rows = {
        "a NUL": b"0,2020,5,0,Aston,1.5\x00,2.5,pano\n",
        "a place of 5,000 digits": b"9" * 5000 + b",2020,5,0,Aston,1.5,2.5,pano\n",
        "a place of 30 digits": b"9" * 30 + b",2020,5,0,Aston,1.5,2.5,pano\n",
        "a city outside": b"0,2020,5,0,../../../../etc,1.5,2.5,pano\n",
        "an absolute city": b"0,2020,5,0,/etc,1.5,2.5,pano\n",
        "a name of 100,000 letters": b"0,2020,5,0," + b"x" * 10**5 + b",1.5,2.5,pano\n",
        "a field of 20 MB": b"0,2020,5,0,Aston,1.5,2.5," + b"x" * 2 * 10**7 + b"\n",
        "a city with escapes": b"0,2020,5,0,\x1b[31m,1.5,2.5,pano\n",
        "below zero": b"-1,2020,5,0,Aston,1.5,2.5,pano\n",
        "words": b"a,b,c,d,e,f,g,h\n",
        "NaN": b"0,2020,5,0,Aston,nan,2.5,pano\n",
    }
    makers = {kind: containing(head + data) for kind, data in rows.items()}
    whole = head + b"0,2020,5,0,Aston,1.5,2.5,pano\n"
    makers["UTF-16"] = containing(whole.decode().encode("utf-16"))
    makers["a folder"] = lambda path: path.mkdir(parents=True)
    for kind, write in makers.items():
        make = with_file("train", "--data", "places/Dataframes/Bad.csv", write, "places")
        yield Case("tables: places", kind, make, ("Bad.csv",))


# ---- Maps ----


def _sealed_in(name: str, change: Callable[[Any], Any]) -> Write:
    """Change a JSON file in a folder, and give it the checksum of what it then is."""

    def write(folder: pathlib.Path) -> None:
        value = json.loads((folder / name).read_text())
        value.pop("checksum", None)
        changed = change(value)
        sealed = isinstance(changed, dict)
        data = checksummed_json(changed) if sealed else json.dumps(changed).encode()
        (folder / name).write_bytes(data)

    return write


def _setting(key: str, new: Any) -> Callable[[Any], Any]:
    return lambda value: value | {key: new}


def _map_with(change: Write) -> Make:
    return with_changed("query", "--map", "map", change)


def _written_in(name: str, data: bytes | str) -> Make:
    return _map_with(lambda folder: containing(data)(folder / name))


def maps() -> Iterator[Case]:
    """Change maps in ways that have the right checksums."""
    eight = range(8)
    records: dict[str, Callable[[Any], Any]] = {
        "a list": lambda value: [1],
        "no names": lambda value: {k: v for k, v in value.items() if k != "names"},
        "names of numbers": _setting("names", list(eight)),
        "names outside": _setting("names", [f"../../../{n}.jpg" for n in eight]),
        "absolute names": _setting("names", [f"/etc/passwd{n}" for n in eight]),
        "names with escapes": _setting("names", [f"\x1b[31m{n}\n.jpg" for n in eight]),
        "names that are no UTF-8": _setting("names", [f"caf\udce9{n}.jpg" for n in eight]),
        "one name eight times": _setting("names", ["a.jpg"] * 8),
        "too few names": _setting("names", ["a.jpg"]),
        "names in a dictionary": _setting("names", {}),
        "bytes of words": _setting("bytes", ["x"] * 8),
        "bytes of NaN": _setting("bytes", [math.nan] * 8),
        "bytes of infinity": _setting("bytes", [math.inf] * 8),
        "positions of words": _setting("positions", ["x"] * 8),
        "positions of one number": _setting("positions", [[1.0]] * 8),
        "positions of NaN": _setting("positions", [[math.nan, math.inf]] * 8),
        "axes of words": _setting("axes", "x"),
        "a number for the axes": _setting("axes", 3),
        "a root of a number": _setting("root", 3),
        "a root of nothing": _setting("root", None),
        "a day of a number": _setting("added", 3),
        "a digest of nothing": _setting("sha256", None),
    }  # fmt: skip
    descriptions: dict[str, Callable[[Any], Any]] = {
        "a list": lambda value: [],
        "format 99": _setting("format", 99),
        "format of words": _setting("format", "x"),
        "a length of 10**12": _setting("descriptor_length", 10**12),
        "a length below zero": _setting("descriptor_length", -1),
        "int8": _setting("dtype", "int8"),
        "a store outside": _setting("store", "../../x"),
        "milvus of nothing": _setting("store", "milvus:"),
        "weights of a number": _setting("weights", 3),
        "weights of a device": _setting("weights", "/dev/zero"),
        "a model of a number": _setting("model", 3),
        "an absurd model": lambda v: _changed(v, ("config", "backbone", "depth"), 10**9),
        "a grouping of words": _setting("grouping", "x"),
        "a collection outside": _setting("collection", "../../x"),
        "an unknown key": _setting("x", 3),
    }
    for name, changes in (("segments/0000000000.json", records), ("map.json", descriptions)):
        for kind, change in changes.items():
            # What a map says of its images, or of where it was made, may be anything of its type.
            fine = kind in ("names with escapes", "a grouping of words", "a collection outside")
            fine |= kind in ("names of numbers", "a digest of nothing", "positions of NaN")
            # Its file says what the model is, and a name may be of any bytes.
            fine |= kind in ("an absurd model", "names that are no UTF-8")
            # Of wrong names or roots, the picture that is not there is told.
            make = _map_with(_sealed_in(name, change))
            yield Case(f"maps: {name}", kind, make, ("map", "images/", "/dev/zero"), fine)
    for kind, data in NPY.items():
        make = _written_in("segments/0000000000.npy", data)
        yield Case("maps: descriptors", kind, make, ("0000000000",))
    texts = {"deep": "[" * 200_000, "NaN": "NaN", "nothing": "", "a key twice": '{"a":1,"a":2}'}
    for name in ("segments/0000000000.json", "map.json"):
        for kind, text in texts.items():
            yield Case(f"maps: {name}", f"text: {kind}", _written_in(name, text), ("map",))


# ---- Layouts of evaluation sets ----


def _netvlad(names: Sequence[str], folder: pathlib.Path) -> None:
    cells, points = test_netvlad.cells([*names]), np.zeros((2, len(names)))
    sides = {"dbImage": cells, "utmDb": points, "numDb": float(len(names))}
    sides |= {"qImage": cells, "utmQ": points, "numQ": float(len(names))}
    test_netvlad.write(folder / "set.mat", **sides)


def _salad(names: Sequence[str], folder: pathlib.Path) -> None:
    folder.mkdir()
    for kind in ("dbImages", "qImages"):
        np.save(folder / f"x_{kind}.npy", np.array(names))
    positives = np.empty(len(names), object)
    positives[:] = [[0]] * len(names)
    np.save(folder / "x_gt.npy", positives)


def _msls(names: Sequence[str], folder: pathlib.Path) -> None:
    for part in ("query", "database"):
        city = folder / "train_val" / "cph" / part
        (city / "images").mkdir(parents=True)
        for table, columns, values in (
            ("raw", ["key", "lon", "lat", "pano"], [0, 0, False]),
            ("postprocessed", ["key", "easting", "northing"], [0, 0]),
        ):
            rows = [[name, *values] for name in names]
            test_msls.write_table(city / f"{table}.csv", columns, rows)


LAYOUTS: Mapping[str, Callable[[Sequence[str], pathlib.Path], None]] = {
    "netvlad": _netvlad,
    "salad": _salad,
    "msls": _msls,
}


def layouts() -> Iterator[Case]:
    """Let lists of evaluation sets name files outside, and strange ones."""
    strange = {
        "outside": ["../outside.png"] * 2,
        "absolute": ["/etc/hostname", "/dev/zero"],
        "a device": ["/dev/zero"] * 2,
        "with escapes": ["\x1b[31m.png", "\n.png"],
        "of 100,000 letters": ["x" * 10**5] * 2,
        "empty": ["", ""],
        "with a NUL": ["a\0b.png", "c.png"],
    }

    def write(layout: str, names: Sequence[str], folder: pathlib.Path) -> None:
        LAYOUTS[layout](names, folder)
        (folder.parent / "outside.png").write_bytes(picture_bytes())

    for layout in LAYOUTS:
        value = "set/set.mat" if layout == "netvlad" else "set"
        for words, names in strange.items():
            change = functools.partial(write, layout, names)
            make = with_file("evaluate", "--data", "set", change, value)
            named = ("set", "outside.png", "/etc", "/dev", "png", "xxx")
            yield Case("layouts: names", f"{layout}: {words}", make, named, words == "outside")


# ---- Comparisons ----


def comparisons() -> Iterator[Case]:
    """Change what a finished comparison left."""
    name = "crisalad+gem/seed-0/result.json"
    for kind, settings in {
        "no settings": {},
        "other settings": {"training": {"epochs": 99}},
    }.items():
        change = _sealed_in(name, _setting("settings", settings))
        make = with_changed("compare", "--out", "comparison", change)
        yield Case(f"comparisons: {name}", kind, make, ("result.json", "comparison"))


# ---- The rest ----


TAKEN = socket.create_server(("", 0))


def processes() -> Iterator[Case]:
    """Give addresses of coordinators that cannot be met."""
    addresses = {
        "a port in use": f"127.0.0.1:{TAKEN.getsockname()[1]}",
        "a port of 99999": "127.0.0.1:99999",
        "a port of 0": "127.0.0.1:0",
        "a port of 5,000 digits": "127.0.0.1:" + "9" * 5000,
        "no port": "127.0.0.1",
        "words": "x",
        "no host": ":8476",
        "escapes": "\x1b[31m:1",
        "auto": "auto",
    }
    for kind, address in addresses.items():
        for index in ("0", "5", "-1"):
            more = ("--coordinator-address", address, "--num-processes", "1", "--process-id", index)
            words = ("process", "coordinator")
            yield Case("processes", f"{kind}, index {index}", with_more("train", *more), words)


def memory() -> Iterator[Case]:
    """Limit the address space."""
    verbs = ("train", "evaluate", "extract", "index", "query", "pca", "convert", "info", "export")
    for verb in verbs:
        for megabytes in (16, 64, 256, 1024):
            words, most = f"{verb}: {megabytes} MB", megabytes * 2**20
            yield Case("memory", words, with_more(verb), fine=True, memory=most)


MARKUP = "<script>alert(1)</script>"


def _no_markup(done: Done, folder: pathlib.Path) -> str | None:
    pages = list((folder / "out").rglob("*.html"))
    if not pages:
        return "no page was written"
    if any("<script>alert" in page.read_text() for page in pages):
        return "markup of a name stands in the page"
    return None


def _no_formula(done: Done, folder: pathlib.Path) -> str | None:
    tables = list((folder / "out").rglob("*.csv"))
    for path in tables:
        for cell in itertools.chain.from_iterable(csv.reader(path.open(newline=""))):
            if re.match(r"[=@\t\r]|[+-](?![\d.]|nan|inf)", cell):
                return f"a spreadsheet runs {cell!r}"
    return None if tables else "no table was written"


def injections() -> Iterator[Case]:
    """Give data sets and weights names that spreadsheets and browsers run."""

    def page(world: World, bad: pathlib.Path) -> list[str]:
        name = bad / MARKUP.replace("/", "\u2215")
        name.symlink_to(world.path("town"))
        weights = bad / '"><script>alert(2)<b>.safetensors'
        shutil.copy(world.path("weights.safetensors"), weights)
        given = with_flag(base("evaluate", world, bad), "--data", str(name))
        return with_flag(given, "--weights", str(weights))

    def table(world: World, bad: pathlib.Path) -> list[str]:
        (bad / "=cmd()").symlink_to(world.path("town"))
        return with_flag(base("compare", world, bad), "--test", str(bad / "=cmd()"))

    yield Case("injections", "a page", page, fine=True, check=_no_markup)
    yield Case("injections", "a table", table, fine=True, check=_no_formula)


def cases(seed: int) -> list[Case]:
    """List all bad inputs."""
    return [
        *wrong_files(), *wrong_targets(), *wrong_values(), *wrong_flags(), *arrays(), *hdf5(seed),
        *configurations(seed), *weights(), *pictures(), *tables(), *maps(), *layouts(),
        *comparisons(), *processes(), *memory(), *injections(),
    ]  # fmt: skip


def judge(case: Case, done: Done, before: set[str], folder: pathlib.Path) -> str | None:
    """Return what is wrong with how a command ended; None where nothing is."""
    if case.attack == "pictures":
        # libpng's own line of a file that was made to be wrong, with right checksums.
        lines = done.err.splitlines(keepends=True)
        err = "".join(line for line in lines if not line.startswith("libpng error: "))
        done = done._replace(err=err)
    wrong = []
    if done.code == HUNG:
        return f"hung: {done.err[-200:]!r}"
    if "Traceback" in done.err:
        wrong.append("a traceback")
    # The C library's own end, where a thread's data find no memory.
    aborted = done.code < 0 or done.err.endswith(": ABORT\n")
    if case.attack == "memory" and aborted:
        return f"{ABORTED}{-done.code}: {done.err[-300:]!r}"
    if not (case.fine and done.code == 0):
        if not done.told_in_one_line():
            wrong.append(f"code {done.code}, {len(done.err.splitlines())} lines")
        last = done.err.strip().splitlines()[-1:] or [""]
        if case.named and not any(name and name in last[0] for name in case.named):
            wrong.append(f"names none of {case.named}")
        left = sorted(files_in(folder / "out") - before) if (folder / "out").is_dir() else ["gone"]
        if left and not all(".partial" in n and "stored in" in done.err for n in left):
            wrong.append(f"left {left[:4]}")
    if any(
        letter in text for text in (done.out, done.err) for letter in ("\x1b", "\x07", "\u202e")
    ):
        wrong.append("escape sequences reach the terminal")
    if done.peak_bytes > MOST_MEMORY:
        wrong.append(f"{done.peak_bytes / 2**30:.1f} GB")
    more = case.check(done, folder)
    if more is not None:
        wrong.append(more)
    return f"{'; '.join(wrong)}: {done.err[-700:]!r}" if wrong else None


def attempt(case: Case, world: World, folder: pathlib.Path) -> str | None:
    """Try a case in a new folder; return what is wrong."""
    (folder / "out").mkdir(parents=True)
    around = files_in(folder.parent)
    try:
        given = case.make(world, folder)
        before = files_in(folder / "out")
        made = files_in(folder.parent)
        slow = 4 if case.attack.startswith("comparisons") or case.fine or case.memory else 1
        done = run(given, cwd=folder, limit=slow * HANGS, memory=case.memory)
        wrong = judge(case, done, before, folder)
        outside = {name for name in files_in(folder.parent) - made - around if "/out" not in name}
        if outside and wrong is None:
            wrong = f"wrote outside: {sorted(outside)[:4]}"
        return wrong
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def try_all(bench: Bench, chosen: Sequence[Case]) -> list[Row]:
    """Try cases, and return their rows."""
    if any("torch" in case.attack or ".pth" in case.words for case in chosen):
        import torch  # noqa: F401  (once, before the forks)
    rows = {case.attack: Row(case.attack, PROMISE) for case in chosen}
    aborts = Row("memory: aborts", UNCAUGHT)
    for number, case in enumerate(chosen):
        wrong = attempt(case, bench.world, bench.folder / "tried" / f"{number}")
        aborted = wrong is not None and wrong.startswith(ABORTED)
        row = aborts if aborted else rows[case.attack]
        row.note(wrong is None or aborted, f"{case.words}: {wrong}")
    return [row for row in (*rows.values(), aborts) if row.tries]


def group_of(case: Case) -> str:
    """Return what stands before the colon of its row."""
    return case.attack.partition(":")[0]


def attack(group: str, bench: Bench, _: float) -> list[Row]:
    """Try all cases of a group."""
    return try_all(bench, [case for case in cases(bench.seed) if group_of(case) == group])


SAMPLED = ("files", "names", "targets", "values", "flags", "configurations", "weights", "tables")
SAMPLE = "a sample"


def attack_sample(bench: Bench, scale: float) -> list[Row]:
    """Try some of those that fail early."""
    quick = [case for case in cases(bench.seed) if group_of(case) in SAMPLED]
    return try_all(bench, bench.random.sample(quick, part_of(200, scale, least=16)))


def attacks() -> dict[str, Attack]:
    """Return an attack for each group of cases, and a sample."""
    groups = dict.fromkeys(map(group_of, cases(0)))
    return {SAMPLE: attack_sample, **{g: functools.partial(attack, g) for g in groups}}


if __name__ == "__main__":
    sys.exit(carry_out(attacks(), __doc__, optional=[SAMPLE], keep=False))
