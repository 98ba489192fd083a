"""Sets of descriptors as `extract` makes them: in files, in memory, or joined from shares."""

import contextlib
import os
import pathlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.loader import OnBadImage
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.retrieval.chunks import check_rows, pieces
from crisalad_jax.retrieval.describe import HeldTokens, described, group, read_tokens
from crisalad_jax.retrieval.descriptor_files import (
    Descriptors,
    RowFile,
    open_npy,
    read_descriptors,
    record_of,
    targets,
    write_descriptors,
)
from crisalad_jax.retrieval.model import Model
from crisalad_jax.retrieval.partial import partial_folder, read_tokens_partly
from crisalad_jax.retrieval.pca import Pca
from crisalad_jax.retrieval.shares import Share
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, wrap_os_errors
from crisalad_jax.utils.locks import BusyFolderError
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.temporaries import in_use, temporary_beside

_COPIED_BYTES = 2**26
"""Size of the rows that are copied at a time."""
_SHARES = "shares"
"""Key of the shares' digest in a set's record."""


@brief
class Extracted(NamedTuple):
    """The descriptors of a set of images."""

    names: list[str]
    """Names of the images that could be read, in order."""
    descriptors: Descriptors
    """Their descriptors, float32; a memory map where they are in a file."""
    skipped: list[str]
    """Names of the images that could not be read."""
    pairs: list[tuple[str, str]] | None
    """Each image with those most similar to it, best first; None where no pairs were asked for."""
    shares_left: int = 0
    """Number of shares that are not there yet; until then this holds the images of one share."""
    joined_elsewhere: bool = False
    """Whether another process joins the shares, so that this holds the images of one share."""


class Work(NamedTuple):
    """Where a set is made."""

    folder: pathlib.Path | None
    """Folder of work that is done and of temporary files; None keeps all in memory."""
    stack: contextlib.ExitStack
    """Removes temporary files."""

    def temporary(self) -> pathlib.Path:
        """Return the name of a temporary file in the folder, which is removed in the end."""
        assert self.folder is not None
        path = temporary_beside(self.folder / "rows.npy")
        self.stack.enter_context(in_use(path))
        return path


class DescribedSet(NamedTuple):
    """Descriptors that are not yet in the files where they were asked for."""

    names: list[str]
    """Names of the images that could be read."""
    descriptors: Descriptors
    skipped: list[str]
    """Names of the images that could not be read."""
    written: pathlib.Path | None
    """A temporary file of the descriptors; None where they are in memory."""


@contextlib.contextmanager
def open_work(out: str | os.PathLike[str] | None) -> Iterator[Work]:
    """Hold the folder of work on the set `out`; hold memory alone where that is None.

    Raises:
        InputError: what `partial_folder` raises.
    """
    with contextlib.ExitStack() as stack:
        if out is None:
            yield Work(None, stack)
            return
        folder = stack.enter_context(partial_folder(pathlib.Path(out)))
        with contextlib.ExitStack() as temporaries:
            yield Work(folder, temporaries)


def describe_set(
    params: Model,
    config: ModelConfig,
    paths: Sequence[pathlib.Path],
    names: Sequence[str],
    work: Work,
    *,
    source: str,
    components: Pca | None,
    grouping: str,
    batch_size: int,
    seed: int,
    on_bad_image: OnBadImage,
    quiet: bool,
) -> DescribedSet:
    """Describe images under a grouping, in files of the work's folder or in memory.

    Raises:
        InputError: an image that cannot be read, or none that can; a descriptor that is not as the
            model says; a full disk.
    """
    options: dict[str, Any] = {
        "batch_size": batch_size,
        "on_bad_image": on_bad_image,
        "quiet": quiet,
    }
    # A single batch is nothing to resume: no work is kept of it, and no digest of the model needed.
    folder = work.folder if len(paths) > batch_size else None
    if folder is None:
        tokens = read_tokens(params, config, paths, label="images", **options)
    else:
        tokens = read_tokens_partly(folder, params, config, paths, **options)
    if not tokens.readable.any():
        raise InputError(f"{source}: found {len(paths)} images, none of them readable")
    how: dict[str, Any] = {"batch_size": batch_size, "seed": seed, "quiet": quiet}
    written = None
    if folder is None:
        descriptors = group(params, config, tokens, grouping, **how)[tokens.readable]
        check_rows(
            descriptors,
            f"{source}: descriptors",
            range(len(descriptors)),
            unit=config.unit_length,
        )
        if components is not None:
            descriptors = components.apply(descriptors)
    else:
        with wrap_os_errors(folder):
            written = work.temporary()
            rows = described(params, config, tokens, grouping, **how)
            _write_rows(written, rows, tokens, config, f"{source}: descriptors")
            if components is not None:
                written = _shortened(written, components, work)
        descriptors = open_npy(written, verify=False)
    readable = [name for name, ok in zip(names, tokens.readable, strict=True) if ok]
    skipped = [name for name, ok in zip(names, tokens.readable, strict=True) if not ok]
    return DescribedSet(readable, descriptors, skipped, written)


def _write_rows(
    path: pathlib.Path,
    rows: Iterator[tuple[np.ndarray, np.ndarray]],
    tokens: HeldTokens,
    config: ModelConfig,
    source: str,
) -> None:
    """Write the descriptors of the images that could be read to a .npy file."""
    places = np.cumsum(tokens.readable) - 1
    with RowFile(path, int(tokens.readable.sum()), config.descriptor_dim) as file:
        for images, descriptors in rows:
            ok = tokens.readable[images]
            if ok.any():
                kept, there = descriptors[ok], places[images[ok]]
                check_rows(kept, source, there, unit=config.unit_length)
                file.write(there, kept)


def _shortened(path: pathlib.Path, components: Pca, work: Work) -> pathlib.Path:
    """Apply components to a file of descriptors, in another that takes its place."""
    descriptors, short = open_npy(path, verify=False), work.temporary()
    start = 0
    with RowFile(short, len(descriptors), len(components.components)) as file:
        for part in components.parts(descriptors):
            file.write(np.arange(start, start + len(part)), part)
            start += len(part)
    path.unlink()
    return short


class SharedSet(NamedTuple):
    """A set that several processes describe, each its share."""

    out: pathlib.Path
    """The file of the whole set."""
    share: Share
    """The share of this process."""
    digest: str
    """Of all that the shares have in common."""

    @property
    def folder(self) -> pathlib.Path:
        """The folder of the shares that are done."""
        return self.out.with_name(f"{self.out.name}.shares")

    def path(self, share: Share) -> pathlib.Path:
        """Return the file of a share's descriptors."""
        return self.folder / f"{share.name}.npy"

    def is_done(self, path: pathlib.Path) -> bool:
        """Return whether a set is there, of these images and settings."""
        if not all(file.exists() for file in targets(path)):
            return False
        record = read_json(record_of(path), "a record of descriptors")
        return record.get(_SHARES) == self.digest

    def left(self) -> list[Share]:
        """Return the shares that are not there yet; a note tells of those of other images."""
        left = [share for share in self.share.others() if not self.is_done(self.path(share))]
        for share in left:
            if record_of(self.path(share)).exists():
                warn(
                    f"{self.path(share)}: found a share of other images or settings; its process "
                    "has to run again, as the others do"
                )
        return left


def extract_share(
    shared: SharedSet,
    paths: Sequence[pathlib.Path],
    names: Sequence[str],
    *,
    batch_size: int,
    record: Mapping[str, Any],
    describe: Callable[[Sequence[pathlib.Path], Sequence[str], Work], DescribedSet],
    finish: Callable[[DescribedSet, Work, Mapping[str, Any]], Extracted],
) -> Extracted:
    """Describe one share of a set; if it is the last one, join all.

    Raises:
        InputError: fewer batches than shares; what `describe` and `finish` raise.
    """
    mine, own = shared.share.of(len(paths), batch_size), shared.path(shared.share)
    more = {_SHARES: shared.digest}
    if shared.is_done(shared.out):
        names, descriptors = read_descriptors(shared.out)
        skipped = read_json(record_of(shared.out), "a record of descriptors")["skipped"]
        return Extracted(names, descriptors, skipped, None)
    if not shared.is_done(own):
        with open_work(own) as work:
            found = describe(paths[mine], names[mine], work)
            whole = {**record, "skipped": found.skipped, **more}
            write_descriptors(
                own,
                found.descriptors,
                found.names,
                whole,
                within=work.folder,
                written=found.written,
            )
    left = len(shared.left())
    if not left:
        with contextlib.ExitStack() as stack:
            try:
                work = stack.enter_context(open_work(shared.out))
            except BusyFolderError:
                warn(f"{shared.out}: another process joins the shares")
            else:
                result = finish(_joined(shared, work), work, more)
                _remove(shared)
                return result
    names, descriptors = read_descriptors(own)
    skipped = read_json(record_of(own), "a record of descriptors")["skipped"]
    return Extracted(names, descriptors, skipped, None, left, joined_elsewhere=not left)


def _joined(shared: SharedSet, work: Work) -> DescribedSet:
    """Join the shares in one file of the work's folder."""
    sets = [read_descriptors(shared.path(share)) for share in shared.share.others()]
    names = [name for listed, _ in sets for name in listed]
    skipped = [
        name
        for share in shared.share.others()
        for name in read_json(record_of(shared.path(share)), "a record")["skipped"]
    ]
    length = sets[0][1].shape[1]
    written, start = work.temporary(), 0
    with (
        wrap_os_errors(written),
        RowFile(written, len(names), length) as file,
        progress_bar("joining", len(names), "rows", quiet=True) as bar,
    ):
        for _, descriptors in sets:
            for part in pieces(descriptors, "share", max(1, _COPIED_BYTES // (4 * length))):
                file.write(np.arange(start, start + len(part)), part)
                start += len(part)
                bar.advance(len(part))
    return DescribedSet(names, open_npy(written, verify=False), skipped, written)


def _remove(shared: SharedSet) -> None:
    """Remove the shares, which are joined."""
    for share in shared.share.others():
        for path in targets(shared.path(share)):
            path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # a user's file is there
        shared.folder.rmdir()
