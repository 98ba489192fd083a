"""Descriptors of a folder or a list of images, in files or in memory."""

import contextlib
import dataclasses
import os
import pathlib
import tempfile
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crisalad_jax.checkpoints import starter
from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.config.checks import check_seed, choose, require
from crisalad_jax.config.io import to_plain
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.frames import file_of
from crisalad_jax.data.images import check_lines, read_pixels
from crisalad_jax.data.positions import Positions
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.remote import for_each, state_of, whole_name
from crisalad_jax.data.sources import ImageSource, open_sources
from crisalad_jax.data.tracks import Track
from crisalad_jax.retrieval.chunks import Descriptors, check_rows
from crisalad_jax.retrieval.describe import (
    check_readable,
    grouped,
    joined,
    shown,
)
from crisalad_jax.retrieval.describer import Describer, describer_of
from crisalad_jax.retrieval.descriptor_files import (
    MADE_BY,
    open_npy,
    targets,
    write_descriptors,
    write_rows,
)
from crisalad_jax.retrieval.grouping import GROUPINGS, batches_of
from crisalad_jax.retrieval.maps.file_store import FileStore
from crisalad_jax.retrieval.on_cluster import Describing
from crisalad_jax.retrieval.pca import Pca, load_pca, pca_hash, shortened
from crisalad_jax.retrieval.segments import SEGMENT, Segments, digest_of
from crisalad_jax.utils.cluster import check_cluster
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import (
    check_no_links,
    check_target,
    wrap_os_errors,
)
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.temporaries import in_use, remove_temporaries, temporary_beside

if TYPE_CHECKING:
    from crisalad_jax.nn.model import Model

StrPath = str | os.PathLike[str]


@brief
class Extracted(NamedTuple):
    """The descriptors of a set of images."""

    names: list[str]
    """Names of the images that could be read, in order."""
    descriptors: Descriptors
    """Their descriptors, float32; a memory map if they are in a file."""
    skipped: list[str]
    """Names of the images that could not be read."""


def extract(
    model: "Model | Runtime",
    images: StrPath | Sequence[StrPath],
    out: StrPath | None = None,
    *,
    fps: float | None = None,
    topic: str | None = None,
    positions: Positions | Track | StrPath | None = None,
    every_metres: float | None = None,
    weights: StrPath | None = None,
    grouping: str = "single",
    seed: int = 0,
    root: StrPath | None = None,
    pca: StrPath | Pca | None = None,
    verify: bool = True,
    reading: Reading = Reading(),
    cluster: str | None = None,
) -> Extracted:
    """Describe images, and write the descriptors to `out` if it is given.

    With `out`, the same call resumes after a kill, and only one process at a time may write there.
    While it runs, tokens and descriptors are in files; memory holds those of a few hundred images.

    Args:
        model: a model from `load`, or a `Runtime`.
        images: a folder, searched with its subfolders in sorted order, another source of images
            (docs/how-to/image-sources.md), or a list of files.
        out: a .npy file, with the names in a second file, or an .h5 file as hloc reads it. A JSON
            file next to it records how it was made. None writes nothing.
        fps: frames per second to take from a video or robot log; None is 1.
        topic: the image topic of a robot log; None uses the only one.
        positions: where images were taken, for `every_metres`, as in `index`.
        every_metres: minimum distance in metres from the last selected image of the same folder or
            video, as in `index`. None selects all images.
        weights: the file that the parameters come from, for the JSON file and for messages.
        grouping: which images attend to each other; one of `GROUPINGS`.
        seed: random seed of the order in the grouping "shuffled".
        root: folder that names are relative to. None is the folder `images`, or that of another
            source; files of a list are then named by their paths.
        pca: components from `fit_pca` that shorten the descriptors, or their file; None uses none.
        verify: whether to check the file `pca` against its checksum.
        reading: how images are read.
        cluster: the Ray cluster that describes them (extra `ray`): "local", "auto",
            "ray://HOST[:PORT]" or "HOST:PORT" (docs/how-to/ray.md). None uses this process.

    Returns:
        Names and descriptors of the images that could be read.

    Raises:
        InputError: the parameters or components do not fit the model; an argument is invalid; no
            cluster is at the address; no image is readable, or an unreadable one is not skipped; a
            name is not a line of text or not under `root`; or a file cannot be read or written.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, Model, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> extract(model, pictures, reading=Reading(quiet=True)).descriptors.shape
        (4, 576)
    """
    describer = describer_of(model, [grouping])
    check_extraction(out, grouping=grouping, seed=seed, cluster=cluster)
    components = pca if pca is None or isinstance(pca, Pca) else load_pca(pca, verify=verify)
    made_by = "model" if weights is None else str(weights)
    length, is_unit = shortened(components, describer, made_by)
    sources = open_sources(images, fps=fps, topic=topic, on_bad_image=reading.on_bad_image)
    if every_metres is not None:
        require(len(sources) == 1, f"every_metres: found {len(sources)} files, expected one source")
        sources = [each.spaced(each.located(positions), every_metres) for each in sources]
    elif positions is not None:
        raise InputError("--positions: found without --every-metres, expected both")
    paths, names = _listed(images, sources, root)
    made = {} if out is None else _made(describer, components)
    reading = reading.fitted(len(paths))
    source = str(images) if isinstance(images, str | os.PathLike) else "images"
    how = (describer, components, cluster, length, is_unit, grouping, seed, reading)
    work = _Work(*how, f"{source}: descriptors", paths, names)
    record = {
        "weights": None if weights is None else starter.named(weights),
        "images": source,
        "fps": fps,
        "every_metres": every_metres,
        "topic": topic,
        "grouping": grouping,
        "batch_size": reading.batch_size,
        "seed": seed,
        "pca": f"{length} components" if isinstance(pca, Pca) else pca and str(pca),
        "model": to_plain(describer.config),
        **made,
    }

    with _work_folder(out) as folder:
        rows, skipped = work.resume(folder, resumes=out is not None)
        listed = [name for stored in rows.records for name in stored["names"]]
        check_readable(source, len(paths), len(listed))
        file = temporary_beside(folder / "rows.npy")
        with in_use(file):
            with wrap_os_errors(folder):
                write_rows(file, (len(listed), length), work.descriptors(rows))
            found = Extracted(listed, open_npy(file, verify=False), skipped)
            if out is None:
                return found._replace(descriptors=np.array(found.descriptors))
            whole = record | {"skipped": skipped}
            write_descriptors(out, found.descriptors, listed, whole, within=folder, written=file)
            return found


def check_extraction(out: StrPath | None, *, grouping: str, seed: int, cluster: str | None) -> None:
    """Check the arguments of an extraction before a model is loaded.

    Args:
        out: as in `extract`, like the others.
        grouping: which images attend to each other.
        seed: random seed of the order in the grouping "shuffled".
        cluster: the address of a Ray cluster.

    Raises:
        InputError: the suffix of `out` or the grouping is unknown; a file cannot be created; the
            seed is out of range; or the address of the cluster is invalid.

    Example:
        >>> check_extraction("descriptors.npy", grouping="single", seed=0, cluster=None)
    """
    for target in [] if out is None else targets(pathlib.Path(out)):
        check_target(target)
    choose("grouping", grouping, GROUPINGS)
    check_seed("seed", seed)
    check_cluster(cluster)


@dataclasses.dataclass(frozen=True)
class _Work:
    """The work of an extraction: to describe images and store their rows step by step.

    The rows are descriptors if every image is described independently, and tokens otherwise.
    """

    describer: Describer
    components: Pca | None
    cluster: str | None
    length: int
    """Number of dimensions of the descriptors that are written."""
    is_unit: bool
    """Whether these are unit vectors."""
    grouping: str
    seed: int
    reading: Reading
    label: str
    """Name of the descriptors in messages."""
    paths: Sequence[pathlib.Path]
    names: Sequence[str]

    def opened(self, folder: pathlib.Path) -> Segments:
        """Open the rows in a folder."""
        if self.grouping == "single":
            length, dtype = self.length, "float32"
        else:
            length, dtype = self.describer.row_length, self.describer.row_dtype
        return Segments(folder, FileStore(folder, length, dtype), dtype)

    def resume(self, folder: pathlib.Path, *, resumes: bool = True) -> tuple[Segments, list[str]]:
        """Describe the images whose rows are not in the folder yet, and store them there.

        Returns:
            All rows, and the names of the images that could not be read.

        Raises:
            InputError: an image cannot be read and `reading` says "stop"; or a descriptor is not
                finite.
        """
        digest = self._digest() if resumes else "none"
        segments = self._reusable(folder, digest)
        skipped = [name for record in segments.records for name in record["skipped"]]
        if skipped and self.reading.on_bad_image == "stop":
            read_pixels(self.paths[self.names.index(skipped[0])])  # raises what it was skipped for
        first = len(segments) + len(skipped)
        is_single, rest = self.grouping == "single", self.paths[first:]
        how = Describing(self.describer, self.reading, self.components, tokens=not is_single)
        new = how.stream(rest, self.cluster)
        new = shown(new, "images", len(self.paths), quiet=self.reading.quiet, done=first)
        for part in joined(new, SEGMENT):
            unreadable = [self.names[first + int(number)] for number in part.unreadable]
            skipped += unreadable
            if not len(part.indices):
                continue
            if is_single:
                check_rows(part.descriptors, self.label, part.indices, unit=self.is_unit)
            names = [self.names[first + int(number)] for number in part.indices]
            record = {"names": names, "skipped": unreadable, "work": digest}
            segments.append(record, part.descriptors)
        return segments, skipped

    def _reusable(self, folder: pathlib.Path, digest: str) -> Segments:
        """Open the stored rows if they are complete and of this extraction, else remove them."""
        try:
            segments = self.opened(folder)
            segments.verify()
            if all(record.get("work") == digest for record in segments.records):
                return segments
            reason = f"{folder}: found results for another model, batch size or images"
        except InputError as error:
            reason = str(error)
        warn(f"{reason}; starting again from the first image")
        _remove_work(folder)
        return self.opened(folder)

    def _digest(self) -> str:
        """Compute a digest of all settings that affect rows, and of file names, sizes and times."""
        settings = {
            **_made(self.describer, self.components),
            "config": to_plain(self.describer.config),
            "batch_size": self.reading.batch_size,
            "rows": "descriptors" if self.grouping == "single" else "tokens",
        }
        states = for_each(lambda path: state_of(file_of(path)), self.paths)
        each = zip(self.names, self.paths, states, strict=True)
        # A missing file is reported when it is read.
        files = [f"{name} {path} {state}" for name, path, state in each if state is not None]
        return digest_of(files, settings)

    def descriptors(self, stored: Segments) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the indices and descriptors of stored rows, some at a time."""
        if self.grouping == "single":
            for span, block in zip(stored.spans, stored.blocks(), strict=True):
                yield np.arange(span.first, span.first + span.count), block
            return
        batches = batches_of(len(stored), self.grouping, self.reading.batch_size, self.seed)
        for numbers, rows in grouped(self.describer, stored, batches, quiet=self.reading.quiet):
            short = rows if self.components is None else self.components.apply(rows)
            check_rows(short, self.label, numbers, unit=self.is_unit)
            yield numbers, short


@contextlib.contextmanager
def _work_folder(out: StrPath | None) -> Iterator[pathlib.Path]:
    """Lock the folder of unfinished descriptors of `out`; remove it after success.

    An error leaves it only if it holds work, and the message then says so. Without `out`, the
    folder is temporary.

    Raises:
        InputError: another process is writing these descriptors, or the folder cannot be created.
    """
    if out is None:
        with tempfile.TemporaryDirectory(prefix="crisalad-") as temporary:
            yield pathlib.Path(temporary)
        return
    folder = pathlib.Path(out).with_name(f"{pathlib.Path(out).name}.partial")
    check_no_links(folder, itself=True)
    with lock(folder):
        remove_temporaries(folder)
        try:
            yield folder
        except BaseException as error:
            if not _records(folder):
                _remove_work(folder)
            elif isinstance(error, InputError):
                raise InputError(
                    f"{error} (finished work is stored in {folder}: the same command resumes)"
                ) from error
            raise
        _remove_work(folder)
    with contextlib.suppress(OSError):  # another process has started, or it holds a user's file
        folder.rmdir()


def _records(folder: pathlib.Path) -> list[pathlib.Path]:
    return sorted(folder.glob("[0-9]*.json"))


def _remove_work(folder: pathlib.Path) -> None:
    """Remove the rows in a folder, their records first."""
    for path in (*_records(folder), *folder.glob("[0-9]*.npy")):
        path.unlink(missing_ok=True)


def _listed(
    images: StrPath | Sequence[StrPath], sources: Sequence[ImageSource], root: StrPath | None
) -> tuple[list[pathlib.Path], list[str]]:
    """List the images, and their names relative to the root."""
    paths = [path for source in sources for path in source.paths]
    if isinstance(images, str | os.PathLike):
        (source,) = sources
        inside = _inside(source.root, root) if root is not None else pathlib.PurePath()
        return paths, [(inside / name).as_posix() for name in source.names]
    names = [(path if root is None else _inside(path, root)).as_posix() for path in paths]
    check_lines(names, "images")
    return paths, names


def _inside(path: pathlib.Path, root: StrPath) -> pathlib.PurePath:
    whole, holder = (pathlib.Path(whole_name(pathlib.Path(each))) for each in (path, root))
    if not whole.is_relative_to(holder):
        raise InputError(f"--root: found {holder}, expected a folder that holds {whole}")
    return whole.relative_to(holder)


def _made(describer: Describer, components: Pca | None) -> dict[str, str | None]:
    """Return hashes of what made the descriptors; only those with equal hashes are comparable."""
    return {
        MADE_BY: describer.digest,
        "pca_sha256": None if components is None else pca_hash(components),
    }
