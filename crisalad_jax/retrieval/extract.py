"""Descriptors of a folder or a list of images, in files or in memory."""

import contextlib
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from crisalad_jax.checkpoints import starter
from crisalad_jax.config.checks import check_count
from crisalad_jax.config.io import to_plain
from crisalad_jax.data.images import check_lines
from crisalad_jax.data.loader import OnBadImage
from crisalad_jax.data.sources import check_rate_used, open_source
from crisalad_jax.data.video import frame_time, name_frame
from crisalad_jax.nn.config import ModelConfig, check_unit_length
from crisalad_jax.retrieval.chunks import check_all_rows
from crisalad_jax.retrieval.descriptor_files import (
    Descriptors,
    check_suffix,
    read_descriptors,
    targets,
    write_descriptors,
)
from crisalad_jax.retrieval.grouping import check_grouping, useful_batch_size
from crisalad_jax.retrieval.hloc_pairs import check_names, nearest_pairs, write_pairs
from crisalad_jax.retrieval.model import Model, check_groupings, check_params
from crisalad_jax.retrieval.pca import Pca, load_pca, pca_hash
from crisalad_jax.retrieval.sets import (
    DescribedSet,
    Extracted,
    SharedSet,
    Work,
    describe_set,
    extract_share,
    open_work,
)
from crisalad_jax.retrieval.shares import Share, digest_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, check_format, check_target, real_path

StrPath = str | os.PathLike[str]


def extract(
    params: Model,
    config: ModelConfig,
    images: StrPath | Sequence[StrPath],
    out: StrPath | None = None,
    *,
    fps: float | None = None,
    weights: StrPath | None = None,
    grouping: str = "single",
    batch_size: int = 16,
    seed: int = 0,
    root: StrPath | None = None,
    pairs: StrPath | None = None,
    database: StrPath | None = None,
    k: int = 20,
    pca: StrPath | Pca | None = None,
    share: str | None = None,
    on_bad_image: OnBadImage = "stop",
    verify: bool = True,
    quiet: bool = False,
) -> Extracted:
    """Describe images, and write the descriptors where they are asked for.

    With `out`, the same call resumes after a kill, and one process at a time may write there.
    Tokens and descriptors are then in files, and a few hundred images' in memory.

    Args:
        params: the model's parameters, or a `Runtime` that has them.
        config: the model; images are resized as it says.
        images: a folder, searched with its subfolders in sorted order, another source of images
            (docs/how-to/image-sources.md), or a list of files.
        out: a file .npy, with the names beside it, or .h5, as hloc reads it. How it was made is
            written beside it too, as JSON. None writes nothing.
        fps: frames a second taken of a video, which is then expected; None is one.
        weights: the file that the parameters are from, for that JSON and for messages.
        grouping: one of `GROUPINGS`: which images look at each other.
        batch_size: number of images described together.
        seed: draws the order of the grouping "shuffled".
        root: folder that names are relative to. By default it is the folder `images`, or that of
            another source; files of a list keep their names.
        pairs: a file for hloc's pairs: each image with those most similar to it, never itself.
        database: descriptors, .h5 or .npy, of the images to pair these with; None is these.
        k: number of pairs of each image.
        pca: components that shorten the descriptors, or a file of them.
        share: INDEX/COUNT, to describe one share of the images; processes on any hosts that see the
            same folders take the others, and the last one to end joins all.
        on_bad_image: "stop" at an unreadable image, or "skip" it.
        verify: whether to check the bytes of `database` and `pca` against their checksums.
        quiet: whether to show no progress bar.

    Returns:
        Names and descriptors of the images that could be read.

    Raises:
        InputError: what `check_params` and `check_extraction` raise; components or a database of
            another length; no image, an image that cannot be read, or none that can; a name that is
            no line of text or does not lie under `root`; or a file that cannot be read or
            written.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> extract(params, config, pictures, quiet=True).descriptors.shape
        (4, 576)
    """
    check_params(params, config)
    check_groupings(params, config, [grouping])
    check_extraction(
        out,
        grouping=grouping,
        batch_size=batch_size,
        seed=seed,
        pairs=pairs,
        database=database,
        k=k,
        share=share,
    )
    components = _components(pca, config, weights, unit=pairs is not None, verify=verify)
    paths, names = _listed(images, root, fps, on_bad_image)
    check_rate_used(fps, paths)
    length = config.descriptor_dim if components is None else len(components.components)
    others = None if pairs is None else _others(pairs, names, database, length, verify=verify)
    batch_size = useful_batch_size(batch_size, len(paths))
    record = {
        "weights": None if weights is None else starter.named(weights),
        "images": _source(images),
        "grouping": grouping,
        "batch_size": batch_size,
        "seed": seed,
        "pca": _words(pca),
        "model": to_plain(config),
    }
    if any(frame_time(path) is not None for path in paths):
        record["fps"] = 1.0 if fps is None else fps

    def describe(paths: Sequence[pathlib.Path], names: Sequence[str], work: Work) -> DescribedSet:
        return describe_set(
            params,
            config,
            paths,
            names,
            work,
            source=_source(images),
            components=components,
            grouping=grouping,
            batch_size=batch_size,
            seed=seed,
            on_bad_image=on_bad_image,
            quiet=quiet,
        )

    def finish(found: DescribedSet, work: Work, more: Mapping[str, Any]) -> Extracted:
        nearest = None
        with contextlib.ExitStack() as staged:  # so that pairs and descriptors appear, or none
            if pairs is not None:
                between = others or (found.names, found.descriptors)
                nearest = nearest_pairs(found.names, found.descriptors, *between, k=k)
                write_pairs(staged.enter_context(atomic_path(pairs)), nearest)
            if out is not None:
                whole = record | {"skipped": found.skipped, **more}
                write_descriptors(
                    out,
                    found.descriptors,
                    found.names,
                    whole,
                    within=work.folder,
                    written=found.written,
                )
        return Extracted(found.names, found.descriptors, found.skipped, nearest)

    if share is None or out is None:
        with open_work(out) as work:
            return finish(describe(paths, names, work), work, {})
    settings = record | {"pca": None if components is None else pca_hash(components)}
    del settings["weights"], settings["images"]  # hosts may call them by other names
    shared = SharedSet(
        pathlib.Path(out), Share.parse(share), digest_of(params, config, names, settings)
    )
    return extract_share(
        shared, paths, names, batch_size=batch_size, record=record, describe=describe, finish=finish
    )


def check_extraction(
    out: StrPath | None,
    *,
    grouping: str = "single",
    batch_size: int = 16,
    seed: int = 0,
    pairs: StrPath | None = None,
    database: StrPath | None = None,
    k: int = 20,
    share: str | None = None,
) -> None:
    """Check what can be checked of an extraction before a model is loaded.

    Args:
        out: as `extract` takes it, and so are the others.
        grouping: which images look at each other.
        batch_size: number of images described together.
        seed: draws the order of the grouping "shuffled".
        pairs: a file for hloc's pairs.
        database: descriptors of the images to pair these with.
        k: number of pairs of each image.
        share: one share of the images.

    Raises:
        InputError: an unknown suffix or grouping; a share of a grouping other than "single", or
            of nothing that is written; a file that cannot be made, or that would take
            the place of another; a number out of range; or a database without pairs.

    Example:
        >>> check_extraction("descriptors.npy", grouping="single")
    """
    files: list[pathlib.Path] = []
    if out is not None:
        check_suffix(out)
        files = targets(pathlib.Path(out))
    for target in (*files, *([] if pairs is None else [pairs])):
        check_target(target)
    if pairs is not None and pathlib.Path(pairs) in files:
        raise InputError(f"--pairs: found {pairs}, which --out writes, expected another")
    if pairs is not None:
        check_format("--pairs", pairs, ".txt")
    if database is not None and pairs is None:
        raise InputError("--database: found without --pairs, expected both")
    check_grouping([grouping], batch_size, seed)
    if pairs is not None:
        check_count("k", k)
    if share is not None:
        Share.parse(share)
        if grouping != "single" or out is None:
            found = f"grouping {grouping}" if out is not None else "no file to write"
            raise InputError(
                f"share: found {found}, expected images that are described alone, into a file"
            )


def _components(
    pca: StrPath | Pca | None,
    config: ModelConfig,
    weights: StrPath | None,
    *,
    unit: bool,
    verify: bool,
) -> Pca | None:
    """Load components, and check that they fit the model and, for pairs, give unit vectors."""
    if pca is None:
        if unit:
            check_unit_length(config, "--pairs")
        return None
    components = pca if isinstance(pca, Pca) else load_pca(pca, verify=verify)
    components.check(config.descriptor_dim, "model" if weights is None else str(weights))
    if unit and not components.config.renormalise:
        raise InputError(
            f"--pairs: found {'components' if isinstance(pca, Pca) else pca}, which leaves lengths "
            "as they are, expected components that make unit vectors, which are paired by cosine"
        )
    return components


def _words(pca: StrPath | Pca | None) -> str | None:
    if pca is None:
        return None
    return f"{len(pca.components)} components" if isinstance(pca, Pca) else str(pca)


def _source(images: StrPath | Sequence[StrPath]) -> str:
    return str(images) if isinstance(images, str | os.PathLike) else "images"


def _listed(
    images: StrPath | Sequence[StrPath],
    root: StrPath | None,
    fps: float | None,
    on_bad_image: OnBadImage,
) -> tuple[list[pathlib.Path], list[str]]:
    """List the images, and their names relative to the root."""
    if isinstance(images, str | os.PathLike):
        source = open_source(images, fps=fps, on_bad_image=on_bad_image)
        inside = _inside(source.root, root) if root is not None else pathlib.PurePath()
        return source.paths, [(inside / name).as_posix() for name in source.names]
    paths = [name_frame(pathlib.Path(path)) for path in images]
    if not paths:
        raise InputError("images: found none, expected at least one")
    names = [(path if root is None else _inside(path, root)).as_posix() for path in paths]
    check_lines(names, "images")
    return paths, names


def _inside(path: pathlib.Path, root: StrPath) -> pathlib.PurePath:
    whole, holder = real_path(path), real_path(root)
    if not whole.is_relative_to(holder):
        raise InputError(f"--root: found {holder}, expected a folder that holds {whole}")
    return whole.relative_to(holder)


def _others(
    pairs: StrPath, names: list[str], database: StrPath | None, length: int, *, verify: bool
) -> tuple[list[str], Descriptors] | None:
    """Read the descriptors to pair the images with; None pairs them with themselves."""
    check_names(pairs, names)
    if database is None:
        return None
    listed, descriptors = read_descriptors(database, verify=verify)
    check_names(pairs, listed)
    if descriptors.shape[1] != length:
        raise InputError(
            f"{database}: found descriptors of {descriptors.shape[1]} numbers, expected {length} "
            "as of these images"
        )
    check_all_rows(descriptors, str(database), unit=True)
    return listed, descriptors
