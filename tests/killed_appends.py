"""Appends to maps, and changes of maps, in processes that die: a program for test_maps.

Forked from one program that has imported everything, a child takes milliseconds. Prints how many
children died.
"""

import functools
import os
import pathlib
import random
import resource
import signal
import sys
import time
from collections.abc import Callable

import numpy as np

import crisalad_jax.retrieval.maps.file_store
from crisalad_jax.config.io import to_plain
from crisalad_jax.data.positions import Positions
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.corrections import merge_maps, move_images, remove_images
from crisalad_jax.retrieval.maps.images import NewImages
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.metadata import MapMetadata, read_metadata
from crisalad_jax.utils.errors import InputError

LENGTH = 48


def metadata(store: str, collection: str = "crisalad_map") -> MapMetadata:
    return MapMetadata(
        model="0" * 64,
        weights="w.safetensors",
        config=to_plain(ModelConfig()),
        descriptor_length=LENGTH,
        store=store,
        collection=collection,
    )


def rows(first: int, count: int) -> np.ndarray:
    """Descriptors of these numbers: functions of the number alone."""
    numbers = range(first, first + count)
    found = np.stack([np.random.default_rng(n).standard_normal(LENGTH) for n in numbers])
    return (found / np.linalg.norm(found, axis=1, keepdims=True)).astype(np.float32)


def names(first: int, count: int) -> list[str]:
    return [f"{number}.jpg" for number in range(first, first + count)]


def append_until(folder: pathlib.Path, total: int, store: str = "files") -> None:
    """In segments of one to five."""
    # One server has the collections of all maps.
    with open_for_appending(folder, metadata(store, f"crisalad_map{folder.name}")) as target:
        while (first := len(target)) < total:
            count = min(1 + first % 5, total - first)
            new = names(first, count)
            target.append(new, [7] * count, rows(first, count), root="/images")


def check(folder: pathlib.Path) -> int:
    """How many images the map has, all of which are as they were appended."""
    if not any((folder / "segments").glob("[0-9]*.json")):
        read_metadata(folder)
        return 0
    with Map.open(folder) as opened:
        opened.verify()
        count = len(opened)
        assert [image.name for image in opened.images] == names(0, count)
        if count:
            assert np.array_equal(np.concatenate(list(opened.descriptors)), rows(0, count))
    return count


def forked(work: Callable[[], object], kill_after: float | None = None) -> int:
    """Do something in a child; its exit code, or minus the signal that it was killed by."""
    child = os.fork()
    if child == 0:
        try:
            work()
            os._exit(0)
        except InputError as error:
            print(error, flush=True)
            os._exit(2)
        except BaseException as error:
            print(repr(error), file=sys.stderr, flush=True)
            os._exit(1)
    if kill_after is not None:
        time.sleep(kill_after)
        os.kill(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def at_random(folder: pathlib.Path, store: str, kills: int, longest: float) -> None:
    """Kill appends after up to `longest` seconds; a map that is finished is followed by another."""
    generator = random.Random(kills)
    killed, number, total = 0, 0, 100
    while killed < kills:
        target = folder / str(number)
        code = forked(
            lambda target=target: append_until(target, total, store),
            kill_after=generator.uniform(0, longest),
        )
        assert code in (0, -signal.SIGKILL), code
        killed += code != 0
        # In a child too: Milvus starts threads, and what has threads should not fork.
        assert forked(lambda target=target: check(target)) == 0
        number += code == 0
    assert forked(lambda: append_until(folder / str(number), total, store)) == 0
    for path in folder.iterdir():
        assert forked(lambda path=path: _expect(check(path), total)) == 0
    print(killed)


def _expect(found: int, expected: int) -> None:
    assert found == expected, (found, expected)


def dying(step: int, work: Callable[[], object]) -> None:
    """Die before a call that changes the disk, or half-way through it."""
    left = step

    def now() -> bool:
        nonlocal left
        left -= 1
        return left < 0

    def instead(module: object, name: str, half: Callable[..., object]) -> None:
        real = getattr(module, name)

        def call(*arguments: object, **options: object) -> object:
            if now():
                half(*arguments, **options)
                os._exit(9)
            return real(*arguments, **options)

        setattr(module, name, call)

    real_bytes = pathlib.Path.write_bytes

    def half_array(path: pathlib.Path, array: np.ndarray) -> None:
        real_bytes(path, array.tobytes()[: array.nbytes // 2])

    def half_bytes(path: pathlib.Path, data: bytes) -> None:
        real_bytes(path, data[: len(data) // 2])

    for name in ("replace", "fsync", "mkdir", "unlink"):
        instead(os, name, lambda *_, **__: None)
    instead(crisalad_jax.retrieval.maps.file_store, "write_npy", half_array)
    instead(pathlib.Path, "write_bytes", half_bytes)
    work()


def others(folder: pathlib.Path) -> list[pathlib.Path]:
    """Two maps to merge, one of which was corrected."""
    maps = [folder.with_name(f"{folder.name} {number}") for number in range(2)]
    for number, path in enumerate(maps):
        if not path.exists():
            append_until(path, 3)
            with open_for_appending(path, metadata("files")) as target:
                new = [f"{number}/{name}" for name in names(0, 2)]
                target.append(new, [7, 7], rows(20 + 2 * number, 2), root="/other")
            remove_images(path, ["1.jpg"])
    return maps


def replace_some(folder: pathlib.Path) -> None:
    """By descriptors of two segments, as `replace_images` does with a model."""
    new = ((["1.jpg", "4.jpg"], 30), (["6.jpg"], 32))
    parts = [NewImages(some, [8] * len(some), rows(n, len(some)), "/new") for some, n in new]
    with open_for_appending(folder, metadata("files")) as target:
        if target.image("6.jpg") == target.images[-1] and target.images[-1].bytes == 7:
            target.change("replace", added=parts)


CHANGES: dict[str, Callable[[pathlib.Path], object]] = {
    "remove": lambda folder: remove_images(folder, ["[25].jpg"]),
    "replace": replace_some,
    "move": lambda folder: move_images(folder, Positions(("x", "y"), {"3.jpg": (1.0, 2.0)})),
    "merge": lambda folder: merge_maps(folder, *others(folder.parent / "others")),
    "merge into a new map": lambda folder: merge_maps(folder, *others(folder.parent / "others")),
}


def begin(verb: str, folder: pathlib.Path) -> None:
    """Make what a change is of."""
    others(folder.parent / "others")
    if verb != "merge into a new map":
        append_until(folder, 7)


def state(folder: pathlib.Path) -> list[tuple] | None:
    """All that a map says of its images; None of one that is not there."""
    if not folder.exists():
        return None
    with Map.open(folder) as opened:
        opened.verify()
        columns = opened.images, np.concatenate(list(opened.descriptors))
        return [(*image, row.tobytes()) for image, row in zip(*columns, strict=True)]


def before_and_after(verb: str, folder: pathlib.Path) -> list[list[tuple] | None]:
    """What a map is before an undisturbed change, and after it."""
    begin(verb, folder)
    states = [state(folder)]
    CHANGES[verb](folder)
    states.append(state(folder))
    assert states[0] != states[1]
    return states


def changes_at_every_step(folder: pathlib.Path, _store: str, _kills: int, _longest: float) -> None:
    """Kill each change at each of its steps: the map is as before, or as after."""
    for verb, change in CHANGES.items():
        either = before_and_after(verb, folder / verb)
        step = 0
        while True:
            target = folder / f"{verb} {step}"
            begin(verb, target)
            work = functools.partial(change, target)
            code = forked(functools.partial(dying, step, work))
            assert state(target) in either, (verb, step)
            if code == 0:
                break
            assert code == 9, code
            change(target)
            assert state(target) == either[1], (verb, step)
            assert not list((target / "segments").glob(".*"))
            step += 1
        print(step)


def changes_at_random(folder: pathlib.Path, _store: str, kills: int, longest: float) -> None:
    """Kill each change at random moments."""
    generator = random.Random(kills)
    for verb, change in CHANGES.items():
        either = before_and_after(verb, folder / verb)
        killed, number = 0, 0
        while killed < kills:
            target = folder / f"{verb} {number}"
            begin(verb, target)
            after = generator.uniform(0, longest)
            code = forked(functools.partial(change, target), kill_after=after)
            assert code in (0, -signal.SIGKILL), code
            assert state(target) in either, (verb, number)
            change(target)
            assert state(target) == either[1], (verb, number)
            killed, number = killed + (code != 0), number + 1
        print(killed)


def at_every_step(folder: pathlib.Path, _store: str, _kills: int, _longest: float) -> None:
    """Die before each call that changes the disk, or half-way through it, one child after another.

    Between 3 images and 7 there are several appends.
    """
    for start in (0, 3):
        step = 0
        while True:
            target = folder / f"{start} {step}"
            if start:
                append_until(target, start)
            work = functools.partial(append_until, target, 7)
            code = forked(lambda step=step, work=work: dying(step, work))
            assert start <= check(target) <= 7
            if code == 0:
                break
            assert code == 9, code
            append_until(target, 7)
            assert check(target) == 7
            assert not list((target / "segments").glob(".*"))
            step += 1
        print(step)


def on_a_full_disk(folder: pathlib.Path, _store: str, _kills: int, _longest: float) -> None:
    """No file may grow beyond some sizes: the description, a record, or descriptors do not fit."""

    def limited(limit: int) -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        append_until(folder / str(limit), 7)

    for limit, start in ((100, 0), (300, 3), (600, 3)):
        if start:
            append_until(folder / str(limit), start)
        assert forked(lambda limit=limit: limited(limit)) == 2
        assert start <= check(folder / str(limit)) < 7
        append_until(folder / str(limit), 7)
        assert check(folder / str(limit)) == 7


if __name__ == "__main__":
    how = {"random": at_random, "steps": at_every_step, "disk": on_a_full_disk}
    how |= {"changes": changes_at_every_step, "random changes": changes_at_random}
    how[sys.argv[1]](pathlib.Path(sys.argv[2]), sys.argv[3], int(sys.argv[4]), float(sys.argv[5]))
