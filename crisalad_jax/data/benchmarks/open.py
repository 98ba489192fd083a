"""Find the layout of an evaluation set, and read it with the layout's options."""

import functools
import inspect
import os
import pathlib
from collections.abc import Callable
from typing import Any

from crisalad_jax.config.checks import PATH, choose, takes
from crisalad_jax.data.benchmarks.benchmark import Benchmark
from crisalad_jax.data.benchmarks.folders import TRUTH, read_folders
from crisalad_jax.data.benchmarks.msls import is_msls, read_msls
from crisalad_jax.data.benchmarks.netvlad import read_netvlad
from crisalad_jax.data.benchmarks.npy_lists import (
    VPR_BENCH_TRUTH,
    find_lists,
    read_salad_lists,
    read_vpr_bench,
)
from crisalad_jax.data.benchmarks.on_disk import find_split, has_sides, has_split, listing
from crisalad_jax.data.benchmarks.utm import QUERIES, has_utm_names, read_utm
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.utils.errors import InputError

LAYOUTS: dict[str, Callable[..., Benchmark]] = {
    "utm": read_utm,
    "vpr-bench": read_vpr_bench,
    "netvlad": read_netvlad,
    "salad": read_salad_lists,
    "msls": read_msls,
    "msls-subtask": functools.partial(read_msls, subtask=True),
    "folders": read_folders,
}
"""Readers of evaluation sets, by layout; each takes some of the options of `open_benchmark`."""


@takes(root=PATH)
def open_benchmark(
    root: str | os.PathLike[str],
    split: str | None = None,
    radius: float | None = None,
    *,
    images: str | os.PathLike[str] | None = None,
    max_heading_difference: float | None = None,
    frames: int | None = None,
    queries: str | None = None,
    ignore_zones: bool = False,
    layout: str | None = None,
    on_bad_image: OnBadImage = "stop",
) -> Benchmark:
    """Read an evaluation set in the given `layout`, or in the one detected from its files.

    An option that is None takes the default of the layout's reader: `read_utm`,
    `read_vpr_bench`, `read_netvlad`, `read_salad_lists`, `read_msls` or `read_folders`.

    Args:
        root: a folder, a NetVLAD `.mat` file, or one of SALAD's `.npy` lists.
        split: "test", "val" or "train".
        radius: largest distance of a positive from its query in metres, inclusive.
        images: folder of the images, for layouts in which a file names them.
        max_heading_difference: largest angle between the headings of a query and a positive, in
            degrees.
        frames: largest difference between the frame numbers of a query and a positive.
        queries: name of the folder of the queries, if there are several.
        ignore_zones: whether to compare @UTM coordinates of all zones as if in one plane.
        layout: a name in `LAYOUTS`, such as "utm"; "msls-subtask" is never detected.
        on_bad_image: "stop" refuses missing images; under "skip" `evaluate` leaves them out.

    Returns:
        The set: queries, database, positions and ground truth.

    Raises:
        InputError: the layout is unknown, or does not take a given option; or its reader refuses
            the set, for example because files are missing.

    Example:
        >>> import shutil
        >>> for side in ("queries", "database"):
        ...     _ = shutil.copytree(pictures, folder / "set" / side)
        >>> len(open_benchmark(folder / "set", layout="folders").queries)
        4
    """
    root = pathlib.Path(root)
    layout = _find_layout(root, split, queries) if layout is None else layout
    read = choose("layout", layout, LAYOUTS)
    options = {
        "split": split,
        "radius": radius,
        "images": images,
        "max_heading_difference": max_heading_difference,
        "frames": frames,
        "queries": queries,
        "ignore_zones": ignore_zones or None,
    }
    given: dict[str, Any] = {name: value for name, value in options.items() if value is not None}
    takes_these = inspect.signature(read).parameters
    if unknown := given.keys() - takes_these:
        known = ", ".join(name for name in takes_these if name in options) or "no option"
        raise InputError(
            f"{root}: found {', '.join(sorted(unknown))} for the layout {layout}, which takes "
            f"{known}"
        )
    if "on_bad_image" in takes_these:
        given["on_bad_image"] = on_bad_image
    return read(root, **given)


def _find_layout(root: pathlib.Path, split: str | None, queries: str | None) -> str:
    if root.is_file() and root.suffix == ".mat":
        return "netvlad"
    if is_msls(root):
        return "msls"
    if has_split(root) or has_sides(root):
        folder, _ = find_split(root, split)
        plain = (folder / TRUTH).exists() or not has_utm_names(folder, queries or QUERIES)
        return "folders" if plain else "utm"
    has_lists = bool(find_lists(root))
    is_bench = (root / "ref").is_dir() and (root / "query").is_dir()
    if is_bench and ((root / VPR_BENCH_TRUTH).exists() or not has_lists):
        return "vpr-bench"
    if has_lists:
        return "salad"
    raise InputError(
        f"{root}: found {listing(root)}; expected images/{{test,val,train}}/, or database/ and "
        "queries/, or ref/, query/ and ground_truth_new.npy, or train_val/ (MSLS), or "
        "..._dbImages.npy; or name a .mat file (NetVLAD)"
    )
