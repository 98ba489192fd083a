"""Build maps from folders of images: each image is described alone, in bounded memory."""

import contextlib
import dataclasses
import os
import pathlib
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from crisalad_jax.config.checks import choose
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.loader import OnBadImage
from crisalad_jax.data.positions import AXES, Positions, exif_positions, positions_of, utm_positions
from crisalad_jax.data.sources import check_rate_used, open_source
from crisalad_jax.data.video import file_of, frame_time
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.retrieval.alone import describe_alone
from crisalad_jax.retrieval.described import Described
from crisalad_jax.retrieval.grouping import check_grouping, useful_batch_size
from crisalad_jax.retrieval.maps.approximate import SEARCHES
from crisalad_jax.retrieval.maps.head import SHARES, check_model, has_images, read_components
from crisalad_jax.retrieval.maps.manifest import MapDescription, describe_map, read_description
from crisalad_jax.retrieval.maps.map import Map, open_for_appending
from crisalad_jax.retrieval.maps.shared import SharedMap
from crisalad_jax.retrieval.maps.store import store_name
from crisalad_jax.retrieval.maps.unrecorded import check_no_record_lost
from crisalad_jax.retrieval.model import Model, check_params, model_hash
from crisalad_jax.retrieval.pca import Pca, load_pca, pca_hash
from crisalad_jax.retrieval.shares import Share, digest_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import real_path
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.progress import progress_bar

SEGMENT = 256
"""Number of images appended together, and so described again at most after a kill."""


@brief
class Indexed(NamedTuple):
    """Counts and names of a folder's images after indexing it."""

    added: int
    there: int
    """Number of images that the map had already."""
    positions: int
    """Number of added images whose position is known."""
    stay: int
    """Number of given positions of images that the map had already; it keeps its own."""
    unreadable: list[str]
    """Names of the images that could not be read."""
    unmatched: list[str]
    """Names in the given positions that no image in the folder has."""
    images: int
    """Number of images that the map has now."""
    description: MapDescription
    """The map's description."""
    recall: float | None = None
    """What the approximate search recalls, see `Map.build_search`; None where none was asked."""
    shares_left: int = 0
    """Number of shares that are not there yet; until then these are counts of one share."""
    joined_elsewhere: bool = False
    """Whether another process joins the shares, so that these are counts of one share."""


def index_images(
    target: Map,
    params: Model,
    root: pathlib.Path,
    paths: Sequence[pathlib.Path],
    *,
    positions: Positions,
    batch_size: int = 16,
    on_bad_image: OnBadImage = "stop",
    quiet: bool = False,
) -> Indexed:
    """Describe images as the map is described, and append them, `SEGMENT` at a time.

    Images whose names the map has are left out, so that the same call resumes after a kill.

    Args:
        target: open for appending.
        params: the map's model.
        root: the folder that names are relative to.
        paths: images in `root`.
        positions: by name, as far as known.
        batch_size: images described at once.
        on_bad_image: whether an image that cannot be read ends it, or is left out.
        quiet: no progress bar.

    Raises:
        InputError: an image cannot be read; a name in the map is of another picture here; or what
            `Map.append` raises.
    """
    config = target.description.config
    names, sizes, new = _new_images(target, root, paths)
    listed = {path.relative_to(root).as_posix() for path in paths}
    target.fitted(names, positions)  # checks them before any work
    stay = sum(target.image(name) is not None for name in positions.of)
    waiting: list[Described] = []
    unreadable: list[str] = []

    def append() -> None:
        chosen = [int(i) for part in waiting for i in part.indices]
        if chosen:
            target.append(
                [names[i] for i in chosen],
                [sizes[i] for i in chosen],
                np.concatenate([part.descriptors for part in waiting]),
                root=real_path(root).as_posix(),
                positions=positions,
            )
        waiting.clear()

    there = len(target)
    stream = describe_alone(
        params,
        config,
        new,
        batch_size=batch_size,
        on_bad_image=on_bad_image,
        components=target.components,
    )
    with progress_bar(
        "images", len(paths), "images", quiet=quiet, done=len(paths) - len(new)
    ) as bar:
        for part in stream:
            waiting.append(part)
            unreadable += [names[i] for i in part.unreadable]
            bar.advance(len(part.indices) + len(part.unreadable))
            if sum(len(part.indices) for part in waiting) >= SEGMENT:
                append()
        append()
    added = target.images[there:]
    return Indexed(
        added=len(added),
        there=len(paths) - len(new),
        positions=sum(image.position is not None for image in added),
        stay=stay,
        unreadable=unreadable,
        unmatched=[name for name in positions.of if name not in listed],
        images=len(target),
        description=target.description,
    )


def _new_images(
    target: Map, root: pathlib.Path, paths: Sequence[pathlib.Path]
) -> tuple[list[str], list[int], list[pathlib.Path]]:
    """List names, sizes and paths of the images that a map does not have.

    Raises:
        InputError: a name in the map is of another picture here.
    """
    names, sizes, new = [], [], []
    for path in paths:
        name, file = path.relative_to(root).as_posix(), file_of(path)
        size = file.stat().st_size if file.is_file() else None  # missing: to be skipped
        if (known := target.image(name)) is None:
            names.append(name)
            sizes.append(size or 0)
            new.append(path)
        elif size not in (None, known.bytes):
            raise InputError(
                f"{path}: found {size} bytes, but the map has {name!r} of {known.bytes} bytes from "
                f"{known.root}, expected new names for new pictures"
            )
    return names, sizes, new


def index(
    params: Model,
    config: ModelConfig,
    images: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    weights: str | os.PathLike[str],
    fps: float | None = None,
    image_size: tuple[int, int] | None = None,
    resize: Sequence[str] = (),
    compute_dtype: Literal["float32", "bfloat16"] | None = None,
    positions: Positions | str | os.PathLike[str] | None = None,
    store: str | None = None,
    dtype: Literal["float32", "float16"] | None = None,
    pca: Pca | str | os.PathLike[str] | None = None,
    search: Literal["exact", "hnsw", "ivf-pq"] | None = None,
    share: str | None = None,
    batch_size: int = 16,
    on_bad_image: OnBadImage = "stop",
    quiet: bool = False,
) -> Indexed:
    """Make a map of a folder of images, or append to it those that it lacks.

    The same call resumes after a kill.

    Args:
        params: the model's parameters.
        config: the model.
        images: the folder, searched with its subfolders; the map names images by their paths in it.
            Or another source of images (docs/how-to/image-sources.md).
        out: the map's folder.
        weights: the file that the parameters are from, which queries load by default.
        fps: frames a second taken of a video, which is then expected; None is one.
        image_size: height and width in pixels. None is the map's, and of a new map the model's.
        resize: words that change how images are resized; see `ModelConfig.resized`. None are the
            map's way, and of a new map the model's.
        compute_dtype: type of the matrix products. None is the map's, and of a new map the model's.
        positions: where images were taken, or a table of it. None is what `images` says, if that
            is a table; else what @UTM names say; else what the EXIF data of JPEGs says. Names of
            several zones of UTM give degrees, or metres of the map's zone.
        store: "files", or "milvus:URI". None is the map's, and of a new map "files".
        dtype: what files keep descriptors as. None is the map's, and of a new map "float32".
        pca: components that shorten the descriptors, or a file of them, of which the map keeps a
            copy. None is the map's, and of a new map none.
        search: the approximate search that is built from the map's descriptors; "exact" removes
            one. None leaves what there is, which is of no use once the map has grown.
        share: INDEX/COUNT, to describe one share of the images; processes on any hosts that see the
            same folders take the others, and the last one to end joins all.
        batch_size: number of images described at once, each as if it were alone.
        on_bad_image: "stop" at an unreadable image, or "skip" it.
        quiet: whether to show no progress bar.

    Returns:
        What became of the images.

    Raises:
        InputError: parameters of another configuration; no image, or none that can be read;
            positions of none of them; a map of another model or of other
            settings; what `index_images`, `describe_map` and `open_for_appending` raise.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad, save_weights
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> weights = folder / "weights.safetensors"
        >>> save_weights(weights, params, config)
        >>> index(params, config, pictures, folder / "map", weights=weights, quiet=True).added
        4
    """
    check_params(params, config)
    check_grouping((), batch_size, seed=0)
    if search is not None:
        choose("search", search, SEARCHES)
    part = None if share is None else Share.parse(share)
    out = pathlib.Path(out)
    description = read_description(out)
    if not has_images(out):
        check_no_record_lost(out)  # before any work
        description = None  # a map that a kill left without images binds nobody
    source = open_source(images, fps=fps, on_bad_image=on_bad_image)
    check_rate_used(fps, source.paths)
    table = source.positions if positions is None else positions
    if table is None:
        known = utm_positions(source.names)
    else:
        known = positions_of(table, source.names, images)
    by_exif = table is None and not known.of
    if table is None and known.axes == AXES[1] and description is None:
        warn(f"{images}: the names are of several zones of UTM: positions become lat, lon")
    components = pca if pca is None or isinstance(pca, Pca) else load_pca(pca)
    batch_size = useful_batch_size(batch_size, len(source.paths))
    if description is None:
        config = config.resized(image_size, resize)
        if compute_dtype is not None:
            config = dataclasses.replace(config, compute_dtype=compute_dtype)
        description = describe_map(
            params,
            config,
            pathlib.Path(weights),
            out,
            store=store or "files",
            dtype=dtype or "float32",
            pca=components,
        )
    else:
        check_model(description, out, model_hash(params, config), weights)
        way = config.preprocessing.changed_by(resize) if resize else None
        _check_settings(description, out, image_size, way, compute_dtype, dtype, store, components)
        components = read_components(out, description)
    if search not in (None, "exact") and description.store != "files":
        raise InputError(
            f"search: found {search}, expected exact, as {description.store} is searched by Milvus"
        )
    options: dict[str, Any] = {
        "batch_size": batch_size,
        "on_bad_image": on_bad_image,
        "quiet": quiet,
    }
    if part is None:
        with open_for_appending(out, description, components) as target:
            if by_exif:
                known = _by_exif(target, source.names, source.paths)
            result = index_images(
                target, params, source.root, source.paths, positions=known, **options
            )
            if not result.images:
                raise InputError(
                    f"{images}: found {len(source.paths)} images, none of them readable"
                )
            if search is not None:
                result = result._replace(recall=target.build_search(search, quiet=quiet))
    else:
        settings = {"dtype": description.dtype, "pca": description.pca, "batch_size": batch_size}
        digest = digest_of(params, description.config, source.names, settings)
        shared = SharedMap(out, part, digest, description, components)
        if by_exif:
            mine = part.of(len(source.paths), batch_size)
            with contextlib.ExitStack() as stack:
                there = None
                if has_images(out):
                    there = stack.enter_context(Map.open(out, verify=False, calibrated=False))
                known = _by_exif(there, source.names[mine], source.paths[mine])
        result = _index_share(
            shared, params, source.root, source.paths, positions=known, search=search, **options
        )
    return result if table is not None else result._replace(stay=0)


def _index_share(
    shared: SharedMap,
    params: Model,
    images: pathlib.Path,
    paths: Sequence[pathlib.Path],
    *,
    positions: Positions,
    batch_size: int,
    search: str | None,
    quiet: bool,
    **options: Any,
) -> Indexed:
    """Index one share of the images in a map of its own; if it is the last one, join all.

    Raises:
        InputError: what `index_images`, `Share.of`, `SharedMap.describe` and `join` raise.
    """
    mine = paths[shared.share.of(len(paths), batch_size)]
    stay, there = 0, 0
    new = list(mine)
    names = {path.relative_to(images).as_posix() for path in paths}
    unmatched = [name for name in positions.of if name not in names]
    if has_images(shared.out):
        with Map.open(shared.out, verify=False, calibrated=False) as whole:
            whole.fitted(names, positions)
            new = _new_images(whole, images, mine)[2]
            there = len(paths) - len(_new_images(whole, images, paths)[2])
            stay = sum(whole.image(name) is not None for name in positions.of)
            known = len(whole)
        if there == len(paths) and not (shared.out / SHARES).exists():
            return Indexed(0, there, 0, stay, [], unmatched, known, shared.description)
    found = Indexed(0, there, 0, stay, [], unmatched, 0, shared.description)

    def work(target: Map) -> dict[str, Any]:
        nonlocal found
        done = index_images(
            target,
            params,
            images,
            new,
            positions=positions,
            batch_size=batch_size,
            quiet=quiet,
            **options,
        )
        located = sum(image.position is not None for image in target.images)
        found = found._replace(
            added=len(target), positions=located, unreadable=done.unreadable, images=len(target)
        )
        return {"added": len(target), "positions": located, "unreadable": done.unreadable}

    if shared.counts(shared.share) is None:
        shared.describe(work)
    if left := shared.left():
        return found._replace(shares_left=left)

    def finish(target: Map) -> None:
        nonlocal found
        if not len(target):
            raise InputError(f"{images}: found {len(paths)} images, none of them readable")
        recall = None if search is None else target.build_search(search, quiet=quiet)
        found = found._replace(images=len(target), recall=recall)

    counts = shared.join(finish, quiet=quiet)
    if counts is None:
        return found._replace(joined_elsewhere=True)
    return found._replace(
        added=sum(each["added"] for each in counts),
        positions=sum(each["positions"] for each in counts),
        unreadable=[name for each in counts for name in each["unreadable"]],
    )


def _by_exif(target: Map | None, names: Sequence[str], paths: Sequence[pathlib.Path]) -> Positions:
    """Read where JPEGs that the map lacks were taken, if its own positions are in degrees too."""
    new = (
        (name, path)
        for name, path in zip(names, paths, strict=True)
        if (target is None or target.image(name) is None) and frame_time(path) is None
    )
    found = exif_positions(new)
    if target is not None and found.of and target.axes not in (None, found.axes):
        warn(
            f"{target.folder}: left out the EXIF positions of {len(found.of)} images, expected "
            f"{', '.join(target.axes or ())} as in the map"
        )
        return utm_positions(())
    return found


def _check_settings(
    description: MapDescription,
    folder: pathlib.Path,
    image_size: tuple[int, int] | None,
    way: PreprocessingConfig | None,
    compute_dtype: str | None,
    dtype: str | None,
    store: str | None,
    pca: Pca | None,
) -> None:
    """Check that the given settings agree with those of an existing map."""
    store = store and store_name(store, folder, description.dtype)
    there = description.config
    if way is not None and way != there.preprocessing:
        raise InputError(
            f"{folder}: found images at {way.in_words(image_size or there.image_size)}, expected "
            f"{there.images_in_words} as in the map"
        )
    for name, given, there in (
        ("image size", image_size, description.config.image_size),
        ("compute dtype", compute_dtype, description.config.compute_dtype),
        ("dtype", dtype, description.dtype),
        ("store", store, description.store),
        ("components", pca and pca_hash(pca)[:12], description.pca[:12] or "none"),
    ):
        if given is not None and given != there:
            raise InputError(f"{folder}: found {name} {given}, expected {there} as in the map")
