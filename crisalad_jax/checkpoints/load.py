"""Load a model from a file, or a published model by its name."""

import dataclasses
import os
import pathlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple

from crisalad_jax.checkpoints import starter
from crisalad_jax.config.checks import PATH, takes
from crisalad_jax.config.io import to_plain
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.hub import download_file, is_hub, parse_hub
from crisalad_jax.utils.output import warn, warn_once

if TYPE_CHECKING:
    from crisalad_jax.checkpoints.engines import EngineName
    from crisalad_jax.checkpoints.runtime import Runtime
    from crisalad_jax.nn.config import ModelConfig
    from crisalad_jax.nn.model import Model

HUB_FILE = "model.safetensors"
"""Name of the weight file in a repository on Hugging Face's hub, or in a folder published there."""


@takes(path=PATH)
def load(path: str | os.PathLike[str], *, verify: bool = True, quiet: bool = False) -> "Model":
    """Load a model from a weight file of this package, a public checkpoint, or by its name.

    Args:
        path: a weight file of this package (.safetensors); a public checkpoint, such as DINOv2's,
            DINO-SALAD's or CricaVPR's (docs/how-to/use-public-checkpoints.md; most need torch); the
            name of a published model, as `crisalad models` lists them, which is downloaded once
            into the cache; "starter", the small model in this package; "hog" or "thumbnail",
            untrained baselines; a folder that `crisalad publish` wrote; or hf://OWNER/NAME, such a
            folder on Hugging Face's hub, optionally with @REVISION and /FILE (needs the extra
            `data`).
        verify: whether to check a weight file of this package against its checksum.
        quiet: whether to hide the progress of a download.

    Returns:
        The model: parameters and configuration.

    Raises:
        InputError: there is no such file or name, the download fails, or the file is damaged or of
            an unknown format.

    Example:
        >>> import jax
        >>> from crisalad_jax import Model, init_crisalad, load, recipe, save_weights
        >>> config = recipe("tiny").model
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> save_weights(folder / "weights.safetensors", model)
        >>> load(folder / "weights.safetensors").config == config
        True
    """
    # Imported here: the public formats take a tenth of a second to import, and few need them.
    from crisalad_jax.checkpoints.public import read_checkpoint

    return read_checkpoint(find_weights(path, quiet=quiet), verify=verify).model


def find_weights(
    weights: str | os.PathLike[str] | None, *, engine: str = "jax", quiet: bool = False
) -> pathlib.Path:
    """Find the weight file for a path, or for the name of a model.

    Names are those of published models; "starter", the small model in this package; and "hog" and
    "thumbnail", untrained baselines. A published model is downloaded the first time. Its licence is
    shown in a warning: at every call, or once per process if it forbids commercial use. A file with
    a model's name in the working directory takes precedence, with a warning.

    Args:
        weights: a path; a name; hf://OWNER/NAME, a repository on Hugging Face's hub; a folder with
            the layout of such a repository; or None, which is "starter", with a warning.
        engine: where the model will run. "auto" accepts an exported folder too; "onnxruntime" and
            "openvino" accept any folder.
        quiet: whether to hide the progress bar.

    Returns:
        The path as given, or the path of the file for a name, in this package or in a cache.

    Raises:
        InputError: a download fails, or there is neither a file nor a model of this name; the
            message lists the nearest names. Other missing files are reported when they are read.

    Example:
        >>> find_weights("megalok")
        Traceback (most recent call last):
        ...
        crisalad_jax.utils.errors.InputError: megalok: found no such file, ...; nearest: megaloc...
    """
    if weights is None:
        warn(
            f"no --weights: taking {starter.NAME}, the small model in this package, trained "
            f"only on rendered images (docs/{starter.NAME}.md); for the best recall: --weights "
            f"{starter.BEST}"
        )
        return starter.FILE
    path = pathlib.Path(weights)
    name = os.fspath(weights)
    if is_hub(name):
        address = parse_hub(name)
        address = dataclasses.replace(address, file=address.file or HUB_FILE)
        return download_file(address, quiet=quiet)
    if path.suffix and os.path.isfile(path):
        return path
    if engine != "jax" and path.is_dir():
        from crisalad_jax.checkpoints.runtime import MANIFEST

        if engine != "auto" or (path / MANIFEST).is_file():
            return path
    # Imported here: a file needs no table of published models.
    from crisalad_jax.checkpoints.published import PUBLISHED, nearest_names

    model = PUBLISHED.get(name)
    if os.path.isfile(path):
        if model is not None or name in starter.FILES:
            warn(f"{name}: found a file of this name here, and took that instead of the model")
        return path
    if name in starter.FILES:
        return starter.FILES[name]
    if model is not None:
        from crisalad_jax.checkpoints.cache import cached_weights

        for each in (model, *filter(None, [PUBLISHED.get(model.backbone)])):
            if each.restriction:
                warn_once(each.name, each.notice)
            else:
                warn(f"{each.name}: {each.notice}")
        return cached_weights(model, quiet=quiet)
    if (path / HUB_FILE).is_file():
        return path / HUB_FILE
    near = nearest_names(path.stem)
    # A name, or a file that looks like a published model's: MegaLoc.pth.
    is_name = path.parent == pathlib.Path() and (not path.suffix or bool(near))
    if is_name and not os.path.lexists(path):
        raise InputError(
            f"{name}: found no such file, and no published model of this name, expected one of the "
            f"two (`crisalad models` lists them{near})"
        )
    return path


class OpenedModel(NamedTuple):
    """A model opened in JAX or another engine, with its name and file."""

    model: "Model | Runtime"
    name: str
    """Name of the model for tables and titles."""
    file: pathlib.Path
    """The weight file, or the exported folder, that was opened."""


def open_model(
    weights: str | os.PathLike[str] | None,
    engine: "EngineName | Literal['jax']",
    changed: "Callable[[ModelConfig], ModelConfig]",
    *,
    groupings: Sequence[str] = ("single",),
    verify: bool = True,
    quiet: bool = False,
) -> OpenedModel:
    """Load a model of this package in JAX, or open it in another engine.

    Args:
        weights: a path or a name, as `find_weights` takes it.
        engine: "jax", "onnxruntime" or "openvino"; the last two also take an exported folder.
        changed: function of the model's configuration that returns the one to describe images with.
        groupings: all groupings under which the model will describe images (`retrieval.grouping`).
        verify: whether to compare files with their checksums.
        quiet: whether to hide the progress of a download.

    Raises:
        InputError: the model cannot be found, read, or opened in `engine`; or `changed` raises it.
    """
    file = find_weights(weights, engine=engine, quiet=quiet)
    short = f"{file.parent.name}/{file.name}" if file.parent.name else file.name
    if is_hub(weights):  # its cache has folders named after commits
        short = str(parse_hub(weights))
    name = starter.named(file) if file in starter.FILES.values() else short
    # Imported here: an engine's model is opened without JAX, and JAX's without an engine.
    if engine == "jax":
        from crisalad_jax.checkpoints.weights import read_weights

        model = read_weights(file, verify=verify).model
        return OpenedModel(model._replace(config=changed(model.config)), name, file)
    from crisalad_jax.checkpoints.runtime import check_takes_photographs, open_runtime, read_model

    config = changed(read_model(file))
    check_takes_photographs(config, file)
    attends = config.cross_image.attends
    model = open_runtime(
        file,
        engine,
        to_plain(config),
        any_grouping=attends and set("/".join(groupings).split("/")) != {"single"},
        verify=verify,
    )
    return OpenedModel(model, f"{name}, {engine}", file)
