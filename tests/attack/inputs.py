"""Give every verb bad inputs: files, folders, numbers, names and settings, a process for each.

    python -m tests.attack.inputs --out rows.json [--seed 0] [--most N] [--quick] [--only WORDS]

A table says for each verb and argument what is bad about it; `--most` takes a sample of that many,
`--quick` only those that need no products of other verbs, `--only` those with these words.
"""

import argparse
import contextlib
import io
import json
import math
import os
import pathlib
import pickle
import random
import resource
import shutil
import socket
import struct
import sys
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from tests.attack.world import (
    ALL,
    HUNG,
    NEEDS,
    PRODUCTS,
    Done,
    Row,
    World,
    files_in,
    import_everything,
    make_products,
    make_world,
    picture_bytes,
    run,
    write_rows,
)

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
    needs: tuple[str, ...] = ()
    """Verbs whose products it takes."""
    memory: int | None = None
    """Limit of the address space beyond the start."""
    check: Callable[[Done, pathlib.Path], str | None] = lambda done, folder: None
    """Returns what else is wrong."""


def of(verb: str, attack: str, words: str, make: Make, *named: str, **more: Any) -> Case:
    """Return a bad input of a verb, with the products that this reads."""
    return Case(attack, words, make, named, needs=NEEDS.get(verb, ()), **more)


def with_flag(arguments: Sequence[str], flag: str, *values: str) -> list[str]:
    """Give a flag other values, in place of those it has."""
    given = list(arguments)
    if flag in given:
        start = given.index(flag)
        end = start + 1
        while end < len(given) and not given[end].startswith("--"):
            end += 1
        del given[start:end]
    return [*given, flag, *values]


def base(verb: str, world: World, folder: pathlib.Path) -> list[str]:
    """Return a verb's good arguments, which write into `folder`/out."""
    return ALL["extract .npy" if verb == "extract" else verb](world, folder / "out")


def put(verb: str, flag: str, given: list[str], *values: str) -> list[str]:
    """Give an argument other values, by its flag or its place."""
    if flag in ("IMAGE", "SRC"):
        return [given[0], *values, *given[2:]]
    if flag == "DST":
        return [*given[:2], *values, *given[3:]]
    if (verb, flag) == ("info", "--map"):
        return ["info", "--map", *values, "--json", given[-1]]
    if flag in ("--recipe", "--preset") and "--weights" in given:
        where = given.index("--weights")
        given = [*given[:where], *given[where + 2 :], "--preset", "tiny"]
    if (verb, flag) == ("compare", "--rerank"):
        given = with_flag(given, "--methods", "patch-netvlad")
    return with_flag(given, flag, *values)


def with_values(verb: str, flag: str, *values: str) -> Make:
    """Give a verb's argument other values."""
    return lambda world, bad: put(verb, flag, base(verb, world, bad), *values)


Write = Callable[[pathlib.Path], Any]
"""Makes the bad file or folder at a path."""


def containing(data: bytes | str | Callable[[], bytes]) -> Write:
    """Write a file of these bytes, or of this text; a function makes them when they are needed."""

    def write(path: pathlib.Path) -> None:
        path.parent.mkdir(exist_ok=True)
        made = data() if callable(data) else data
        path.write_bytes(made.encode() if isinstance(made, str) else made)

    return write


def with_file(verb: str, flag: str, name: str, write: Write, value: str | None = None) -> Make:
    """Make something bad, and give it to a verb's flag.

    Args:
        verb: a command.
        flag: a flag of it, or IMAGE, SRC or DST.
        name: of what `write` makes.
        write: makes it.
        value: what the flag gets, below the folder of the case; None is what was made.
    """

    def make(world: World, bad: pathlib.Path) -> list[str]:
        write(bad / name)
        return put(verb, flag, base(verb, world, bad), str(bad / (value or name)))

    return make


def with_more(verb: str, *more: str) -> Make:
    """Give a verb more arguments than its good ones."""
    return lambda world, bad: [*base(verb, world, bad), *more]


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


def _bomb(path: pathlib.Path) -> None:
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("archive/data.pkl", "w", force_zip64=True) as file,
    ):
        for _ in range(2048):
            file.write(bytes(2**20))


def _torch_bomb(path: pathlib.Path) -> None:
    """Write a checkpoint of a tensor of zeros of 4 GB that takes 4 MB: compressed."""
    import torch

    plain = path.with_name("plain.pth")
    torch.save({"state_dict": {"a": torch.zeros(2**10)}}, plain)
    with zipfile.ZipFile(plain) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            if name.endswith("/data/0"):
                with new.open(name, "w", force_zip64=True) as file:
                    for _ in range(4096):
                        file.write(bytes(2**20))
            else:
                data = old.read(name)
                new.writestr(name, data)
    plain.unlink()


def _huge_storage(path: pathlib.Path) -> None:
    import torch

    meta = torch.zeros(1).as_strided((2**20, 2**18), (0, 0))
    torch.save({"state_dict": {"cls_token": meta}}, path)


FILES: Mapping[str, Callable[[pathlib.Path], Any]] = {
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
    "compare": "--train places/, --test town/, --backbone backbone.safetensors, --page page.md",
    "ablate": "--train places/",
}
"""Arguments of each verb, with the name of the bad file; a folder is right in place of NAME/."""
RIGHT = {("--plugin", kind) for kind in ("an empty file", "a list in JSON")}  # right Python
RIGHT |= {("IMAGE", "a folder"), ("IMAGE", "a picture")}


def wrong_files() -> Iterator[Case]:
    """Put something else in place of each file and folder."""
    for verb, arguments in FILE_ARGUMENTS.items():
        for flag, name in (argument.split() for argument in arguments.split(", ")):
            words, is_folder = f"{verb} {flag} {name}", name.endswith("/")
            for kind in FOLDERS if is_folder else FILES:
                if (flag, kind) not in RIGHT:
                    make = with_file(verb, flag, name.rstrip("/"), FILES[kind])
                    yield of(verb, f"files: {kind}", words, make, name.rstrip("/"), flag)
            for value in ("", "-", "x" * 300, "no\x1b[31mred\nline", "caf\udce9", "/dev/zero"):
                # Empty values are refused before flags are told apart.
                named = (flag, "argument", value[:20], "red", "caf", flag.lower())
                make = with_values(verb, flag, value)
                yield of(verb, f"names: {value[:12]!r}", f"{verb} {flag}", make, *named)


# ---- Targets ----

TARGETS = {
    **{"evaluate": "--json --out --report", "extract": "--out --pairs", "convert": "DST"},
    **{"query": "--json --gallery", "info": "--json"},
    **dict.fromkeys(("train", "index", "pca", "export", "vocabulary"), "--out"),
    **dict.fromkeys(("compare", "demo", "render"), "--out"),
}
SUFFIX = {
    ("extract", "--out"): ".npy",
    ("pca", "--out"): ".safetensors",
    ("convert", "DST"): ".pth",
    ("vocabulary", "--out"): ".safetensors",
    ("query", "--gallery"): ".png",
}


def _below_file(path: pathlib.Path) -> pathlib.Path:
    path.write_text("a file")
    return path / f"x{path.suffix}"


def _below_loop(path: pathlib.Path) -> pathlib.Path:
    (path.parent / "loop").symlink_to("loop")
    return path.parent / "loop" / path.name


def _made(make: Callable[[pathlib.Path], Any]) -> Callable[[pathlib.Path], pathlib.Path]:
    def made(path: pathlib.Path) -> pathlib.Path:
        make(path)
        return path

    return made


def _full_folder(path: pathlib.Path) -> pathlib.Path:
    path.mkdir()
    (path / "mine.txt").write_text("mine")
    return path


BAD_TARGETS: Mapping[str, Callable[[pathlib.Path], pathlib.Path]] = {
    "below a file": _below_file,
    "below a loop of links": _below_loop,
    "a pipe": _made(os.mkfifo),
    "a socket": _made(_socket),
    "a link to a device": _made(lambda path: path.symlink_to("/dev/zero")),
    "a folder with files": _full_folder,
    "a name of 300 letters": lambda path: path.with_name("x" * 300 + path.suffix),
    "in /proc": lambda path: pathlib.Path("/proc/none") / path.name,
}


def wrong_targets() -> Iterator[Case]:
    """Let each verb write to where nothing can be written, or must not be."""
    targets = [(verb, flag) for verb, flags in TARGETS.items() for flag in flags.split()]
    for verb, flag in targets:
        for kind, prepare in BAD_TARGETS.items():
            # A folder of pictures or pages may hold others.
            if kind != "a folder with files" or verb != "evaluate" or flag == "--json":
                make, words = _with_target(verb, flag, prepare), f"{verb} {flag}"
                named = ("target", "xxx", "loop", "/proc", "mine")
                yield of(verb, f"targets: {kind}", words, make, *named)


def _with_target(verb: str, flag: str, prepare: Callable[[pathlib.Path], pathlib.Path]) -> Make:
    def make(world: World, bad: pathlib.Path) -> list[str]:
        target = prepare(bad / f"target{SUFFIX.get((verb, flag), '')}")
        return put(verb, flag, base(verb, world, bad), str(target))

    return make


# ---- Numbers and words ----

HUGE = "99999999999999999999"
VALUES: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    *(
        (verb, "--seed", ("-1", HUGE, str(2**32), "1.5", "nan", "x", "0x10"))
        for verb in ("evaluate", "extract", "pca", "vocabulary", "demo", "render", "train")
    ),
    *(
        (verb, "--image-size", ("1400000014 1400000014", "0 0", "-14 -14", "13 14", "x 14", "14"))
        for verb in ("train", "evaluate", "extract", "index", "info", "export", "vocabulary")
    ),
    *((verb, "--image-size", ("1400000014 1400000014", "0 0")) for verb in ("compare", "ablate")),
    *(
        (verb, "--batch-size", ("0", "-1", HUGE, "1e9", "x"))
        for verb in ("evaluate", "extract", "index", "query", "info", "vocabulary", "compare")
    ),
    *(
        (verb, "--max-pixels", ("0", "-1", HUGE, "x", "1e3"))
        for verb in ("evaluate", "extract", "index", "query", "train", "compare")
    ),
    ("extract", "--k", ("0", "-1", HUGE)),
    ("query", "--k", ("0", "-1")),
    ("evaluate", "--seeds", ("0", "-1", "1e9", HUGE)),
    ("compare", "--seeds", ("0", "-1", "1e9")),
    ("evaluate", "--radius", ("-1", "nan", "inf", "x", "1e400")),
    ("evaluate", "--frames", ("-1", "3", HUGE)),
    ("evaluate", "--max-heading-difference", ("-1", "nan", "400", "x")),
    ("evaluate", "--grouping", (",", "foo", "single/", "/", "single/foo/bar", "single,,")),
    ("evaluate", "--rerank", ("x", ":", "patch-netvlad:0", "transvpr:-1", f"transvpr:{HUGE}")),
    ("evaluate", "--split", ("x", "../test", "train")),
    ("evaluate", "--layout", ("x", "netvlad", "salad", "msls")),
    ("evaluate", "--queries", ("../../..", "/etc", "x")),
    ("evaluate", "--preset", ("x",)),
    ("evaluate", "--compute-dtype", ("float8",)),
    ("train", "--epochs", ("0", "-1", HUGE, "1e9", "x")),
    ("train", "--places-per-batch", ("0", "-1", HUGE)),
    ("train", "--images-per-place", ("0", "-1", HUGE)),
    ("train", "--min-images", ("0", "-1", HUGE)),
    ("train", "--patience", ("-1", "x")),
    ("train", "--save-top-k", ("-1",)),
    ("train", "--num-threads", ("-1", "x")),
    ("train", "--optimiser.learning-rate", ("-1", "nan", "inf", "x")),
    ("train", "--model.aggregator", ("x",)),
    ("train", "--model.backbone.heads", ("0", "3", "-1", HUGE)),
    ("train", "--model.backbone.dim", ("0", "-1", HUGE)),
    ("train", "--model.backbone.depth", ("0", "-1")),
    ("train", "--trainable", ("x", "last-0-blocks+head", "last-99-blocks+head")),
    ("train", "--augmentation", ("x",)),
    ("train", "--cities", ("x", "../Aston")),
    ("train", "--num-processes", ("2", "-1")),
    ("train", "--recipe", ("x", "salad")),
    ("compare", "--epochs", ("0", "-1", HUGE)),
    ("compare", "--methods", ("x", "gem,gem", ",", "../gem")),
    ("compare", "--rerank", ("0", "-1")),
    ("compare", "--weights", ("x", "gem=", "=x", "gem=/dev/zero")),
    ("compare", "--grouping", ("x",)),
    ("compare", "--preset", ("x",)),
    ("compare", "--jobs", ("0", "-1", "x")),
    ("compare", "--reference", ("x",)),
    ("ablate", "--rows", ("x", "step:x", ",")),
    ("ablate", "--row", ("x", ":", "x: epochs", "x: epochs=0", f"x: epochs={HUGE}", "x: x=1")),
    ("pca", "--dim", ("0", "-1", HUGE, "7.5")),
    ("pca", "--samples", ("0", "-1", "1")),
    ("export", "--platforms", (",", "x", "cpu,x")),
    ("export", "--batch-size", ("0", "-1", "x")),
    ("export", "--grouping", ("x",)),
    ("info", "--preset", ("x",)),
    ("info", "--trainable", ("x", "last-99-blocks+head")),
    ("convert", "--format", ("x", "huggingface", "cricavpr")),
    ("vocabulary", "--clusters", ("0", "-1", HUGE, "1000000000")),
    ("vocabulary", "--max-images", ("0", "-1")),
    ("vocabulary", "--aggregator", ("x", "gem")),
    ("vocabulary", "--layer", ("3",)),
    ("index", "--store", ("x", "milvus", "milvus:", "../files")),
    ("index", "--dtype", ("int8",)),
    ("render", "--scenes", ("0", "-1", "x")),
    ("render", "--sceneries", ("x",)),
    ("render", "--repaint", ("-1", "nan", "inf", "1e6")),
    ("render", "--varied", ("sun",)),
)


def wrong_values() -> Iterator[Case]:
    """Give flags values that are out of range, or nothing of their kind."""
    for verb, flag, values in VALUES:
        for value in values:
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
                ("train", "--trainable", "last-0-blocks+head"),  # the head alone
                ("evaluate", "--queries", "../../.."),
            )
            make = with_values(verb, flag, *value.split())
            yield of(verb, f"values: {flag}", f"{verb} {value}", make, *named, fine=fine)


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
            yield of(verb, "flags", f"{verb}: {words}", make, *named, fine=fine)
    for given in (["x"], ["--frobnicate"], [""], ["train"], ["\x1b[31m"], ["\udce9"]):
        yield Case("flags", f"{given}", lambda world, bad, given=given: list(given))
    # A flag given twice: the last one counts, or it is refused.
    for verb, flag, first, last in (("extract", "--seed", "1", "-1"), ("pca", "--dim", "3", "0")):
        words, make = f"{verb} {flag} twice", with_more(verb, flag, first, flag, last)
        yield of(verb, "flags", words, make, flag, flag.strip("-"))


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
    needs = ("extract .npy",)
    for kind, data in NPY.items():
        make = with_file("pca", "--descriptors", "bad.npy", containing(data))
        yield Case("arrays: pca", kind, make, ("bad.npy", "dim"), needs=needs)
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
    import h5py

    layout = h5py.VirtualLayout((96,), "f4")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (96,))
    file.create_virtual_dataset(DATASET, layout)


def _deep_groups(file: Any) -> None:
    for _ in range(1000):
        file = file.create_group("g")
    file.create_dataset("global_descriptor", data=np.ones(96, "f4"))


def _links(file: Any) -> None:
    import h5py

    file["a"], file["b"] = h5py.SoftLink("/b"), h5py.SoftLink("/a")


def _external_link(file: Any) -> None:
    import h5py

    file["a"] = h5py.ExternalLink("/etc/passwd", "/x")


def _empty(file: Any) -> None:
    import h5py

    file.create_dataset(DATASET, data=h5py.Empty("f4"))


def _lengths(file: Any) -> None:
    file.create_dataset(DATASET, data=np.ones(96, "f4"))
    file.create_dataset("b/global_descriptor", data=np.ones(95, "f4"))


def _dataset(name: str, *shape: Any, **options: Any) -> Callable[[Any], Any]:
    return lambda file: file.create_dataset(name, *shape, **options)


DATASET = "a/global_descriptor"
H5: Mapping[str, Callable[[Any], Any]] = {
    "a TB": _dataset(DATASET, (2**38,), "f4", chunks=(2**20,), compression=1),
    "external": _dataset(DATASET, (96,), "f4", external=[("/etc/passwd", 0, 384)]),
    "virtual": _virtual,
    "an external link": _external_link,
    "links in a circle": _links,
    "a group in itself": lambda file: file.create_group("a").__setitem__("b", file["/"]),
    "groups 1,000 deep": _deep_groups,
    "a number": _dataset(DATASET, data=1.0),
    "text": _dataset(DATASET, data="text"),
    "fields": _dataset(DATASET, data=np.zeros(4, [("x", "f4")])),
    "a name with a line break": _dataset("a\nb\x1b[31m/global_descriptor", data=np.ones(96, "f4")),
    "a name that is no UTF-8": _dataset("cafe/global_descriptor", data=np.ones(96, "f4")),
    "lengths that differ": _lengths,
    "empty": _empty,
    "integers": _dataset(DATASET, data=np.ones(96, "i4")),
    "nothing": lambda file: None,
}


def _with_h5(write: Callable[[World, pathlib.Path], Any]) -> Make:
    """Give `extract` a database, and a picture at which it ends at the latest."""

    def make(world: World, bad: pathlib.Path) -> list[str]:
        write(world, bad / "bad.h5")
        containing(b"\xff\xd8 no picture")(bad / "pictures" / "broken.jpg")
        given = with_flag(base("extract", world, bad), "--images", str(bad / "pictures"))
        return with_flag(given, "--database", str(bad / "bad.h5"))

    return make


def _h5(kind: str) -> Callable[[World, pathlib.Path], Any]:
    def write(_: World, path: pathlib.Path) -> None:
        import h5py

        with h5py.File(path, "w") as file:
            H5[kind](file)
        if kind == "a name that is no UTF-8":
            path.write_bytes(path.read_bytes().replace(b"cafe", b"caf\xe9"))

    return write


def _damaged_h5(place: float, change: bytes, cut: bool) -> Callable[[World, pathlib.Path], Any]:
    def write(world: World, path: pathlib.Path) -> None:
        data = bytearray(world.path("d.h5").read_bytes())
        start = int(place * len(data))
        data[start : None if cut else start + 8] = b"" if cut else change
        path.write_bytes(data)

    return write


def hdf5(seed: int) -> Iterator[Case]:
    """Damage .h5 files, and let them claim what they do not hold."""
    for kind in H5:
        yield Case("HDF5", kind, _with_h5(_h5(kind)), ("bad.h5",))
    generator = random.Random(seed)
    for number in range(48):
        place, change, cut = generator.random(), generator.randbytes(8), number % 6 == 0
        words = f"{'cut at' if cut else change.hex() + ' at'} {place:.4f}"
        named, needs = ("bad.h5", "broken.jpg"), ("extract .h5",)
        make = _with_h5(_damaged_h5(place, change, cut))
        yield Case("HDF5: damaged", words, make, named, needs=needs)


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
    plain = to_plain(RECIPE)
    places = list(_leaves(plain))
    for _ in range(60):
        place, new = generator.choice(places), generator.choice(STRANGE)
        words = f"{'.'.join(map(str, place))} = {new!r}"
        make = _without_places(containing(json.dumps(_changed(plain, place, new))))
        yield Case("configurations: strange values", words, make)
    model = to_plain(MODEL)
    places = list(_leaves(model))
    for _ in range(40):
        place, new = generator.choice(places), generator.choice(STRANGE)
        words = f"{'.'.join(map(str, place))} = {new!r}"
        made_of = _weights_of(_changed(model, place, new))
        attack = "weights: strange configurations"
        yield Case(attack, words, made_of, ("bad.safetensors",), fine=True)
    for words, place, new in (
        ("a depth of 10**9", ("backbone", "depth"), 10**9),
        ("a dim of 10**9", ("backbone", "dim"), 10**9),
        ("images of 14 * 10**8", ("image_size",), [14 * 10**8, 14 * 10**8]),
        ("10**9 clusters", ("aggregator", "clusters"), 10**9),
        ("a feedforward of 10**12", ("cross_image", "feedforward"), 10**12),
    ):
        changed = _changed(model, place, new)
        yield Case("weights: strange configurations", words, _weights_of(changed), ("bad.safe",))


def _without_places(write: Write) -> Make:
    """Give `train` a configuration, and a folder at which it ends at the latest."""
    with_config = with_file("train", "--config", "bad.json", write)

    def make(world: World, bad: pathlib.Path) -> list[str]:
        (bad / "no-places").mkdir()
        return with_flag(with_config(world, bad), "--data", str(bad / "no-places"))

    return make


def _weights_of(config: Any) -> Make:
    """Make weights whose checksum is right and whose configuration is not."""

    def make(world: World, bad: pathlib.Path) -> list[str]:
        from crisalad_jax.checkpoints.safetensors_io import read_sealed, write_sealed
        from crisalad_jax.checkpoints.weights import FORMAT

        value, arrays = read_sealed(world.weights, FORMAT, "weights")
        path = bad / "bad.safetensors"
        write_sealed(path, arrays, FORMAT, value | {"config": config})
        return with_flag(base("info", world, bad), "--weights", str(path))

    return make


def _safetensors(header: bytes, body: bytes = bytes(64), length: int | None = None) -> bytes:
    return (len(header) if length is None else length).to_bytes(8, "little") + header + body


SAFETENSORS: Mapping[str, bytes] = {
    "a header of 2**62 bytes": _safetensors(b"{}", length=2**62),
    "a header of 90 MB, deep": _safetensors(b'{"a":' * 18_000_000),
    "a deep header": _safetensors(b'{"__metadata__":' + b"[" * 10**5),
    "metadata of numbers": _safetensors(b'{"__metadata__": {"crisalad": 3}}'),
    "no arrays": _safetensors(b"{}", b""),
    "offsets beyond": _safetensors(b'{"a":{"dtype":"F32","shape":[4],"data_offsets":[0,999]}}'),
    "offsets below zero": _safetensors(b'{"a":{"dtype":"F32","shape":[4],"data_offsets":[-4,12]}}'),
    "a shape of 2**62": _safetensors(
        b'{"a":{"dtype":"F32","shape":[4611686018427387904,4],"data_offsets":[0,64]}}'
    ),
    "an unknown type": _safetensors(b'{"a":{"dtype":"F3","shape":[16],"data_offsets":[0,64]}}'),
    "a type of 8 bits": _safetensors(
        b'{"a":{"dtype":"F8_E4M3","shape":[64],"data_offsets":[0,64]}}'
    ),
    "bytes that are no UTF-8": _safetensors(b'{"caf\xe9":{}}'),
    "a name with escapes": _safetensors(
        b'{"\\u001b[31m\\n":{"dtype":"F32","shape":[16],"data_offsets":[0,64]}}'
    ),
    "metadata nested deep": _safetensors(
        json.dumps({"__metadata__": {"crisalad-jax 3": "[" * 10**5}}).encode(), b""
    ),
}


class _Call:
    def __reduce__(self) -> Any:
        return os.system, ("touch /tmp/crisalad-pwned",)


def _deep_pickle() -> bytes:
    return b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b"."


def _without_weights(make: Make) -> Make:
    def made(world: World, bad: pathlib.Path) -> list[str]:
        given = make(world, bad)
        where = given.index("--weights")
        return given[:where] + given[where + 2 :]

    return made


def weights() -> Iterator[Case]:
    """Damage weights and checkpoints."""
    for kind, data in SAFETENSORS.items():
        for verb, flag in (("info", "--weights"), ("convert", "SRC"), ("train", "--backbone")):
            make = with_file(verb, flag, "bad.safetensors", containing(data))
            make = _without_weights(make) if verb == "train" else make
            yield Case("weights: safetensors", f"{verb}: {kind}", make, ("bad.safetensors",))
    makers: Mapping[str, Write] = {
        "a call": containing(pickle.dumps(_Call())),
        "nested deep": containing(_deep_pickle()),
        "a bomb of 4 GB": _torch_bomb,
        "a tensor that claims 2**38 numbers": _huge_storage,
        "a list": containing(pickle.dumps([1, 2])),
        "a pickle that recurses": containing(b"\x80\x02]q\x00h\x00a."),
        "memo of 2**31": containing(b"\x80\x02Nr\xff\xff\xff\x7f."),
        "a long of 2**31 bytes": containing(b"\x80\x02\x8b\xff\xff\xff\x7f."),
        "numbers by text": containing(b"\x80\x02L" + b"9" * 10**6 + b"L\n."),
    }
    for kind, maker in makers.items():
        yield Case("weights: torch", kind, _converted(maker), ("bad.pth",), check=_not_run)


def _converted(write: Write) -> Make:
    def make(world: World, bad: pathlib.Path) -> list[str]:
        write(bad / "bad.pth")
        return ["convert", str(bad / "bad.pth"), str(bad / "out" / "x.safetensors")]

    return make


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


def _jpeg(height: int, width: int) -> bytes:
    import cv2

    done, data = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))
    assert done
    whole = bytearray(data.tobytes())
    at = whole.index(b"\xff\xc0") + 5
    whole[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(whole)


def _tiff(width: int, height: int) -> bytes:
    tags = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1),
            (273, 4, 1, 8), (277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, 100)]  # fmt: skip
    entries = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    return (
        b"II*\0" + struct.pack("<I", 108) + bytes(100) + struct.pack("<H", 9) + entries + bytes(4)
    )


def _webp(width: int, height: int) -> bytes:
    bits = (width - 1) | (height - 1) << 14
    body = b"VP8L" + struct.pack("<I", 6) + b"\x2f" + struct.pack("<I", bits) + b"\0"
    return b"RIFF" + struct.pack("<I", len(body) + 4) + b"WEBP" + body


def _bmp(width: int, height: int) -> bytes:
    head = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, 0, 0, 1, 1, 0, 0)
    return b"BM" + struct.pack("<III", 200, 0, 54) + head + bytes(99)


PICTURES: Mapping[str, Callable[[], bytes]] = {
    "a PNG of 40,000 x 40,000": lambda: _png(40_000, 40_000, 40_000),
    "a PNG of 2**31 - 1 squared": lambda: _png(2**31 - 1, 2**31 - 1, 0),
    "a PNG of no size": lambda: _png(0, 0, 0),
    "a PNG cut short": lambda: picture_bytes()[:-20],
    "a PNG without pixels": lambda: _png(100, 100, 0),
    "a JPEG of 65,535 x 65,535": lambda: _jpeg(65_535, 65_535),
    "a JPEG of no height": lambda: _jpeg(0, 16),
    "a TIFF of 2**31": lambda: _tiff(2**31, 2**31),
    "a TIFF of 60,000 x 60,000": lambda: _tiff(60_000, 60_000),
    "a TIFF that points at itself": lambda: b"II*\0\x08\0\0\0" + b"\xff" * 64,
    "a WebP of 16,384 x 16,384": lambda: _webp(16_384, 16_384),
    "a BMP of 2**31": lambda: _bmp(2**31 - 1, 2**31 - 1),
    "a BMP of -2**31": lambda: _bmp(9, -(2**31)),
    "text": lambda: b"<svg/>",
    "a GIF": lambda: b"GIF89a" + bytes(40),
}


def _linked(made: Sequence[tuple[str, str]]) -> Write:
    """Make a folder of pictures with links, and one picture at which it ends at the latest."""

    def write(folder: pathlib.Path) -> None:
        for name, target in made:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).symlink_to(target)
        (folder / "broken.jpg").write_bytes(b"broken")

    return write


def _printed(make: Make, more: Sequence[str]) -> Make:
    """Let a query print its answers, or draw them."""

    def made(world: World, bad: pathlib.Path) -> list[str]:
        given = [*make(world, bad)[:2], "--map", str(world.path("map")), "--quiet"]
        return [*given, *(each.replace("OUT", str(bad / "out")) for each in more)]

    return made


def pictures() -> Iterator[Case]:
    """Give pictures that are none, claim any size, or have names that terminals obey."""
    for kind, data in PICTURES.items():
        for verb, flag in (("extract", "--images"), ("index", "--images"), ("query", "IMAGE")):
            make = with_file(verb, flag, "pictures/bad.png", containing(data), "pictures")
            yield of(verb, "pictures", f"{verb}: {kind}", make, "bad.png")
    # A link to the root would find pictures of all kinds.
    for kind, made in {
        "a folder that links to itself": (("a/b", "../a"),),
        "two folders that link to each other": (("a/x", "../b"), ("b/y", "../a")),
    }.items():
        make = with_file("extract", "--images", "pictures", _linked(made))
        yield Case("pictures: links", kind, make, ("broken.jpg", "pictures"))
    names = {
        "escapes": "a\x1b[31mb.jpg", "a line break": "a\nb.jpg", "no UTF-8": "caf\udce9.jpg",
        "a bell and a carriage return": "a\x07\rb.jpg", "right to left": "a\u202eb.jpg",
    }  # fmt: skip
    attack, needs = "pictures: names", ("index",)
    for kind, name in names.items():
        for words, data in (("broken", b"broken"), ("whole", picture_bytes())):
            path = f"pictures/{name}"
            make = with_file("extract", "--images", path, containing(data), "pictures")
            yield Case(attack, f"extract: {kind}, {words}", make, fine=True)
            make = with_file("query", "IMAGE", path, containing(data))
            yield Case(attack, f"query: {kind}, {words}", make, fine=True, needs=needs)
            for more in (["--json", "-"], ["--gallery", "OUT/g.png"], []):
                if words == "whole":
                    made = _printed(make, more)
                    yield Case(attack, f"query {more}: {kind}", made, fine=True, needs=needs)

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
        "UTF-16": (head + b"0,2020,5,0,Aston,1.5,2.5,pano\n").decode().encode("utf-16"),
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
        "a folder": b"",
    }
    for kind, data in rows.items():
        write = _table(None if kind == "a folder" else data if kind == "UTF-16" else head + data)
        make = with_file("train", "--data", "places", write)
        yield Case("tables: places", kind, make, ("Bad.csv",))


def _table(data: bytes | None) -> Write:
    """Write a training set with this table; None is a folder of its name."""

    def write(folder: pathlib.Path) -> None:
        table = folder / "Dataframes" / "Bad.csv"
        table.parent.mkdir(parents=True)
        table.mkdir() if data is None else table.write_bytes(data)

    return write


# ---- Maps ----


def _sealed(path: pathlib.Path, change: Callable[[Any], Any]) -> None:
    """Change a JSON file, and give it the checksum of what it then is."""
    from crisalad_jax.utils.checksums import checksummed_json

    value = json.loads(path.read_text())
    value.pop("checksum", None)
    changed = change(value)
    if isinstance(changed, dict):
        path.write_bytes(checksummed_json(changed))
    else:
        path.write_text(json.dumps(changed))


def _setting(key: str, new: Any) -> Callable[[Any], Any]:
    return lambda value: value | {key: new}


def _with_map(change: Callable[[pathlib.Path], Any]) -> Make:
    """Change a copy of the map, and ask it."""

    def make(world: World, bad: pathlib.Path) -> list[str]:
        shutil.copytree(world.path("map"), bad / "map")
        change(bad / "map")
        return with_flag(base("query", world, bad), "--map", str(bad / "map"))

    return make


def _sealed_in(name: str, change: Callable[[Any], Any]) -> Write:
    return lambda folder: _sealed(folder / name, change)


def _written_in(name: str, data: bytes | str) -> Write:
    return lambda folder: containing(data)(folder / name)


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
            make = _with_map(_sealed_in(name, change))
            yield Case(
                f"maps: {name}", kind, make, ("map", "images/", "/dev/zero"), fine, ("index",)
            )
    for kind, data in NPY.items():
        make = _with_map(_written_in("segments/0000000000.npy", data))
        yield Case("maps: descriptors", kind, make, ("0000000000",), needs=("index",))
    texts = {"deep": "[" * 200_000, "NaN": "NaN", "nothing": "", "a key twice": '{"a":1,"a":2}'}
    for name in ("segments/0000000000.json", "map.json"):
        for kind, text in texts.items():
            make = _with_map(_written_in(name, text))
            yield Case(f"maps: {name}", f"text: {kind}", make, ("map",), needs=("index",))


# ---- Layouts of evaluation sets ----


def _layout(bad: pathlib.Path, kind: str, names: Sequence[str]) -> pathlib.Path:
    """Make an evaluation set whose files name these images."""
    folder = bad / "set"
    folder.mkdir()
    (folder / "inside.png").write_bytes(picture_bytes())
    (bad / "outside.png").write_bytes(picture_bytes())
    if kind == "netvlad":
        import scipy.io

        cells = np.empty((len(names), 1), object)
        cells[:, 0] = names
        points = np.zeros((2, len(names)))
        value = {
            "dbStruct": {
                "whichSet": "test", "dataset": "x", "dbImageFns": cells, "utmDb": points,
                "qImageFns": cells, "utmQ": points, "numImages": len(names),
                "numQueries": len(names), "posDistThr": 25.0, "posDistSqThr": 625.0,
                "nonTrivPosDistSqThr": 100.0,
            }
        }  # fmt: skip
        scipy.io.savemat(folder / "set.mat", value)
        return folder / "set.mat"
    if kind == "salad":
        array = np.array(names)
        for name in ("dbImages", "qImages"):
            np.save(folder / f"x_{name}.npy", array)
        positives = np.empty(len(names), object)
        positives[:] = [[0]] * len(names)
        np.save(folder / "x_gt.npy", positives)
        return folder
    for part in ("query", "database"):
        city = folder / "train_val" / "cph" / part
        (city / "images").mkdir(parents=True)
        keys = "\n".join(f"{n},{name},0,0" for n, name in enumerate(names))
        (city / "postprocessed.csv").write_text(
            ",key,easting,northing,unique_cluster,night,control_panel,view_direction\n"
            + "\n".join(f"{n},{name},0,0,{n},False,False,Forward" for n, name in enumerate(names))
        )
        (city / "raw.csv").write_text(",key,lon,lat,ca,pano\n" + keys)
        (city / "seq_info.csv").write_text(",key,sequence_key,frame_number\n" + keys)
        (city / "subtask_index.csv").write_text(",all\n0,True\n")
    return folder


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
    for kind in ("netvlad", "salad", "msls"):
        for words, names in strange.items():
            named = ("set", "outside.png", "/etc", "/dev", "png", "xxx")
            fine = words == "outside"
            yield Case("layouts: names", f"{kind}: {words}", _listed(kind, names), named, fine)


def _listed(kind: str, names: Sequence[str]) -> Make:
    def make(world: World, bad: pathlib.Path) -> list[str]:
        return with_flag(base("evaluate", world, bad), "--data", str(_layout(bad, kind, names)))

    return make


# ---- Comparisons ----


def comparisons() -> Iterator[Case]:
    """Change what a finished comparison left."""
    name = "crisalad+gem/seed-0/result.json"
    for kind, settings in {
        "no settings": {},
        "other settings": {"training": {"epochs": 99}},
    }.items():
        make = _with_comparison(_sealed_in(name, _setting("settings", settings)))
        named = ("result.json", "comparison")
        yield Case(f"comparisons: {name}", kind, make, named, needs=("compare",))


def _with_comparison(change: Write) -> Make:
    def make(world: World, bad: pathlib.Path) -> list[str]:
        shutil.copytree(world.path("comparison"), bad / "comparison")
        change(bad / "comparison")
        return with_flag(base("compare", world, bad), "--out", str(bad / "comparison"))

    return make


# ---- The rest ----


def processes() -> Iterator[Case]:
    """Give addresses of coordinators that cannot be met."""
    taken = socket.socket()
    taken.bind(("", 0))
    taken.listen()
    port = taken.getsockname()[1]
    held.append(taken)
    addresses = {
        "a port in use": f"127.0.0.1:{port}",
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


held: list[socket.socket] = []


def memory() -> Iterator[Case]:
    """Limit the address space."""
    verbs = ("train", "evaluate", "extract", "index", "query", "pca", "convert", "info", "export")
    for verb in verbs:
        for megabytes in (16, 64, 256, 1024):
            words, most = f"{verb}: {megabytes} MB", megabytes * 2**20
            yield of(verb, "memory", words, with_more(verb), fine=True, memory=most)


MARKUP = "<script>alert(1)</script>"


def _no_markup(done: Done, folder: pathlib.Path) -> str | None:
    pages = list((folder / "out").rglob("*.html"))
    if not pages:
        return "no page was written"
    if any("<script>alert" in page.read_text() for page in pages):
        return "markup of a name stands in the page"
    return None


def _no_formula(done: Done, folder: pathlib.Path) -> str | None:
    import csv

    for path in (folder / "out").rglob("*.csv"):
        for row in csv.reader(path.open(newline="")):
            for cell in row:
                if cell[:1] in ("=", "+", "-", "@", "\t", "\r") and not _is_number(cell):
                    return f"a spreadsheet runs {cell!r}"
    return None if list((folder / "out").rglob("*.csv")) else "no table was written"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def injections() -> Iterator[Case]:
    """Give data sets and weights names that spreadsheets and browsers run."""

    def page(world: World, bad: pathlib.Path) -> list[str]:
        name = MARKUP.replace("/", "\u2215")
        (bad / name).symlink_to(world.town)
        shutil.copy(world.weights, bad / '"><script>alert(2)<b>.safetensors')
        given = with_flag(base("evaluate", world, bad), "--data", str(bad / name))
        return with_flag(given, "--weights", str(bad / '"><script>alert(2)<b>.safetensors'))

    def table(world: World, bad: pathlib.Path) -> list[str]:
        (bad / "=cmd()").symlink_to(world.town)
        return with_flag(base("compare", world, bad), "--test", str(bad / "=cmd()"))

    yield Case("injections", "a page", page, fine=True, check=_no_markup)
    yield Case("injections", "a table", table, fine=True, check=_no_formula, needs=("compare",))


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


def attack(case: Case, world: World, folder: pathlib.Path) -> str | None:
    """Try a case in a new folder; return what is wrong."""
    (folder / "out").mkdir(parents=True)
    around = files_in(folder.parent)
    try:
        arguments = case.make(world, folder)
        before = files_in(folder / "out")
        made = files_in(folder.parent)
        slow = 4 if case.needs == ("compare",) or case.fine or case.memory else 1
        done = run(arguments, cwd=folder, limit=slow * HANGS, memory=case.memory)
        wrong = judge(case, done, before, folder)
        outside = {name for name in files_in(folder.parent) - made - around if "/out" not in name}
        if outside and wrong is None and case.attack != "comparisons":
            wrong = f"wrote outside: {sorted(outside)[:4]}"
        return wrong
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def main() -> int:
    """Attack, and write the rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--most", type=int, default=None)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    import_everything()
    chosen = [case for case in cases(given.seed) if given.only in f"{case.attack}: {case.words}"]
    if given.quick:
        slow = ("memory", "injections", "layouts: names")
        chosen = [case for case in chosen if not case.needs and case.attack not in slow]
    random.Random(given.seed).shuffle(chosen)
    chosen = chosen[: given.most]
    if any("torch" in case.attack or ".pth" in case.words for case in chosen):
        import torch  # noqa: F401  (once, before the forks)
    rows = {case.attack: Row(case.attack, PROMISE) for case in chosen}
    with contextlib.ExitStack() as stack:
        folder = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        world = make_world(folder / "world")
        needed = {need for case in chosen for need in case.needs}
        make_products(world, [verb for verb in (*PRODUCTS, "compare") if verb in needed])
        started = time.monotonic()
        for number, case in enumerate(chosen, start=1):
            wrong = attack(case, world, folder / "tried" / f"{number}")
            aborted = wrong is not None and wrong.startswith(ABORTED)
            row = rows.setdefault("memory: aborts", Row("memory: aborts", UNCAUGHT))
            row = row if aborted else rows[case.attack]
            row.note(wrong is None or aborted, f"{case.words}: {wrong}")
            if wrong is not None:
                print(f"{case.attack}: {case.words}: {wrong}", file=sys.stderr)
            if number % 20 == 0 or number == len(chosen):
                seconds = time.monotonic() - started
                failed = sum(len(row.failures) for row in rows.values())
                line = f"{number} of {len(chosen)} inputs, {failed} failures, {seconds:.0f} s"
                print(line, file=sys.stderr)
                write_rows(given.out, [row for row in rows.values() if row.tries])
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(f"largest process: {peak:.2f} GB", file=sys.stderr)
    return 1 if any(row.failures for row in rows.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
