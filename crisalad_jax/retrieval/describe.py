"""Describe images: each independently, with the frames before it, or in groups.

Nothing here imports JAX: the computation is in a `Describer`.
"""

import os
import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.config.checks import require
from crisalad_jax.config.short_repr import brief, in_one_line
from crisalad_jax.data.loader import ImageBatch
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.resize import Pixels
from crisalad_jax.retrieval.describer import Describer, Rows, describer_of
from crisalad_jax.retrieval.grouping import MASKED, Batches, batches_of
from crisalad_jax.retrieval.pca import Pca
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.shapes import Bool, Float, Float32, Int64

if TYPE_CHECKING:  # an engine describes images without JAX
    from crisalad_jax.nn.config import ModelConfig
    from crisalad_jax.nn.model import Model
    from crisalad_jax.retrieval.segments import Segments

_T = TypeVar("_T")


@brief
class Described(NamedTuple):
    """Descriptors of a few images."""

    indices: Int64[np.ndarray, " n"]
    """Indices of the readable images in the list of paths."""
    descriptors: Float32[np.ndarray, "n d"]
    unreadable: Int64[np.ndarray, " _"]
    """Indices of the images that could not be read."""


def prepare_image(image: np.ndarray, config: "ModelConfig", name: str = "image") -> Pixels:
    """Resize an image as a model expects it, and normalise it unless the model takes bytes.

    Args:
        image: 8-bit RGB (height, width, 3), from `read_image`; or grey (height, width) or (height,
            width, 1), repeated over the channels; or a type that `PreprocessingConfig.bit_depth`
            converts to 8 bits.
        config: the model's configuration.
        name: name of the image, for messages.

    Returns:
        An image for a batch of `describe`: 8-bit pixels, or normalised float32.

    Raises:
        InputError: the image is not such an array, or the model cannot describe this size.

    Example:
        >>> import numpy as np
        >>> from crisalad_jax import PRESETS
        >>> prepare_image(np.zeros((60, 80, 3), np.uint8), PRESETS["b14"]).shape
        (224, 224, 3)
    """
    if not hasattr(config, "side_multiple"):
        raise InputError(f"config: found {type(config).__name__}, expected ModelConfig")
    return Preparation.of(config).prepare(image, name)


def _as_list(name: str, given: Any) -> list[Any]:
    """Return a file or a list of images as a list.

    Raises:
        InputError: it is neither, or an empty list.
    """
    if not isinstance(given, str | os.PathLike | Iterable):
        raise InputError(f"{name}: found {in_one_line(given)}, expected images")
    found = [given] if isinstance(given, str | os.PathLike) else list(given)
    require(bool(found), f"{name}: found none, expected at least one image")
    return found


def check_readable(source: object, tried: int, readable: int) -> None:
    """Raise InputError if none of the `tried` images of a source could be read."""
    require(readable > 0, f"{source}: found {tried} images, none of them readable")


def describe_files(
    model: "Model | Runtime | Describer",
    files: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    reading: Reading = Reading(quiet=True),
) -> Float32[np.ndarray, "image descriptor"]:
    """Describe image files, each independently of the others.

    Files are decoded upright and resized according to the model's configuration. `extract` does the
    same for folders, and can write the descriptors to files.

    Args:
        model: a model from `load`, or a `Runtime`.
        files: an image file, or a list of them.
        reading: how the files are read; `on_bad_image` says whether to skip unreadable ones.

    Returns:
        A descriptor of each readable file, in order; unit vectors if `model.config.unit_length`.

    Raises:
        InputError: no files are given, one is unreadable and not skipped, or the parameters do not
            match the configuration.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, Model, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> describe_files(model, pictures / "0.png").shape
        (1, 576)
    """
    describer = describer_of(model)
    paths = [pathlib.Path(file) for file in _as_list("files", files)]
    stream = described(describer, paths, reading.fitted(len(paths)))
    stream = shown(stream, "images", len(paths), quiet=reading.quiet)
    return concatenated(list(stream)).descriptors


def describe_images(
    model: "Model | Runtime | Describer", images: Sequence[np.ndarray], batch_size: int = 16
) -> Float32[np.ndarray, "image descriptor"]:
    """Describe images in memory, each independently of the others.

    Batches are padded to powers of two, so few programs are compiled, and a single image is not
    padded. Values differ from those of `describe_files` by rounding, because batch sizes differ.

    Args:
        model: a model from `load`, or a `Runtime`.
        images: 8-bit RGB, of any sizes, as `read_image` returns them, or grey; see `prepare_image`.
        batch_size: maximum number of images described together.

    Returns:
        A descriptor of each image, in order; unit vectors if `model.config.unit_length`.

    Raises:
        InputError: no images are given, `prepare_image` does not accept one, or the parameters do
            not match the configuration.

    Example:
        >>> import jax, numpy as np
        >>> from crisalad_jax import PRESETS, Model, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> describe_images(model, [np.zeros((60, 80, 3), np.uint8)]).shape
        (1, 576)
    """
    describer, reading = describer_of(model), Reading(batch_size=batch_size)
    how, given = describer.preparation, _as_list("images", images)
    prepared = [how.prepare(image) for image in given]
    return describe_prepared(describer, prepared, reading.batch_size)


def describe_prepared(
    describer: Describer, prepared: Sequence[Pixels], batch_size: int
) -> Float32[np.ndarray, "image descriptor"]:
    """Describe images that `prepare_image` returned, each independently; see `describe_images`."""
    by_shape: dict[tuple[int, ...], list[int]] = {}
    for number, image in enumerate(prepared):
        by_shape.setdefault(image.shape, []).append(number)

    def batches() -> Iterator[ImageBatch]:
        for numbers in by_shape.values():
            for start in range(0, len(numbers), batch_size):
                part = np.array(numbers[start : start + batch_size])
                count = min(batch_size, 1 << (len(part) - 1).bit_length())
                images = np.stack([prepared[part[i % len(part)]] for i in range(count)])
                yield ImageBatch(images, part, np.ones(len(part), bool), part)

    found = {
        int(number): descriptor
        for rows, batch in describer.tokens(batches())
        for number, descriptor in zip(batch.indices, _alone(describer, rows), strict=False)
    }
    return np.stack([found[number] for number in range(len(prepared))])


def _alone(describer: Describer, rows: Rows) -> Float[np.ndarray, "image descriptor"]:
    """Compute the descriptors of images that attend only to themselves."""
    return describer.attend(rows[None], np.eye(len(rows), dtype=bool)[None])[0]


def described(
    describer: Describer,
    paths: Sequence[pathlib.Path],
    reading: Reading,
    *,
    window: int = 1,
    components: Pca | None = None,
) -> Iterator[Described]:
    """Describe images in order, batch by batch, each with the `window - 1` images before it.

    Images that cannot be read are left out. The grouping is "window", or "single" for a window of
    1. Memory holds two batches, and the images that are read ahead. `components` shorten the
    descriptors. With a window of 1 they shorten whole batches, so that a descriptor does not
    depend, not even by rounding, on which other images could be read.

    Raises:
        InputError: an image cannot be read and `reading.on_bad_image` is "stop"; or the window does
            not fit the model (see `FrameDescriber`).
    """
    shorten = (lambda rows: rows) if components is None else components.apply
    frames = FrameDescriber(describer, window)

    def describe(rows: Rows, valid: Bool[np.ndarray, " image"]) -> Rows:
        if window == 1:
            return shorten(_alone(describer, rows))[valid]
        return shorten(frames.of_tokens(rows[valid]))

    return _each_batch(describer, paths, reading, describe)


def token_rows(
    describer: Describer, paths: Sequence[pathlib.Path], reading: Reading
) -> Iterator[Described]:
    """Yield the tokens of images in order, batch by batch, in the field `descriptors`.

    Raises:
        InputError: an image cannot be read and `reading.on_bad_image` is "stop".
    """
    return _each_batch(describer, paths, reading, lambda rows, valid: rows[valid])


def _each_batch(
    describer: Describer,
    paths: Sequence[pathlib.Path],
    reading: Reading,
    describe: Callable[[Rows, Bool[np.ndarray, " image"]], Rows],
) -> Iterator[Described]:
    """Apply `describe` to the tokens of each batch, padding included, and yield the results."""
    batches = reading.batches(paths, describer.preparation)
    for rows, batch in describer.tokens(batches):
        unreadable = batch.indices[(batch.indices >= 0) & ~batch.valid]
        yield Described(batch.indices[batch.valid], describe(rows, batch.valid), unreadable)


def shown(
    stream: Iterator[Described], label: str, total: int, *, quiet: bool, done: int = 0
) -> Iterator[Described]:
    """Pass descriptors through, and show a progress bar that starts at `done` of `total` images."""
    with progress_bar(label, total, "images", quiet=quiet, done=done) as bar:
        for part in stream:
            yield part
            bar.advance(len(part.indices) + len(part.unreadable))


def joined(stream: Iterator[Described], size: int) -> Iterator[Described]:
    """Join parts until they have at least `size` descriptors; the last may have fewer, or none."""
    waiting: list[Described] = []
    for part in stream:
        waiting.append(part)
        if sum(len(each.indices) for each in waiting) >= size:
            yield concatenated(waiting)
            waiting.clear()
    if waiting:
        yield concatenated(waiting)


def concatenated(parts: Sequence[Described]) -> Described:
    """Join the descriptors of consecutive images."""
    return Described(*map(np.concatenate, zip(*parts, strict=True)))


def readable(
    stream: Iterator[Described], size: int, items: Sequence[_T], unreadable: list[_T]
) -> Iterator[tuple[list[_T], Rows]]:
    """Yield items and descriptors of the images that could be read, at least `size` at a time.

    Args:
        stream: descriptors of the images, in order.
        size: minimum number of descriptors to join.
        items: an item for each image, such as its name.
        unreadable: a list, to which the items of unreadable images are appended.
    """
    for part in joined(stream, size):
        unreadable.extend(items[index] for index in part.unreadable)
        if len(part.indices):
            yield [items[index] for index in part.indices], part.descriptors


class TokenSet:
    """Tokens of images in memory, from which the images are described under any grouping."""

    def __init__(
        self,
        describer: Describer,
        paths: Sequence[pathlib.Path],
        reading: Reading,
        label: str = "images",
    ) -> None:
        """Read the images, as in `token_rows`."""
        stream = token_rows(describer, paths, reading)
        stream = shown(stream, label, len(paths), quiet=reading.quiet)
        _, self.rows, self.unreadable = concatenated(list(stream))
        self._describer, self._reading, self._label = describer, reading, label

    def batches(self, grouping: str, batch_size: int | None, seed: int = 0) -> Batches:
        """Group the readable images; a batch size of None is the one they were read in."""
        size = batch_size or self._reading.batch_size
        return batches_of(len(self.rows), grouping, size, seed)

    def describe(self, batches: Batches) -> Float[np.ndarray, "image descriptor"]:
        """Return the descriptors of the readable images, grouped in these batches."""
        options = {"label": self._label, "quiet": self._reading.quiet}
        return group(self._describer, self.rows, batches, **options)


def group(
    describer: Describer, rows: Rows, batches: Batches, **options: Any
) -> Float[np.ndarray, "image descriptor"]:
    """Return descriptors of images grouped in batches, in image order; options as in `grouped`."""
    descriptors = np.empty((len(rows), describer.config.descriptor_dim), np.float32)
    for images, found in grouped(describer, rows, batches, **options):
        descriptors[images] = found
    return descriptors


def grouped(
    describer: Describer,
    rows: "Rows | Segments",
    batches: Batches,
    *,
    first: int = 0,
    label: str = "images",
    quiet: bool = True,
) -> Iterator[tuple[Int64[np.ndarray, " n"], Float[np.ndarray, "n descriptor"]]]:
    """Yield the indices and descriptors of images in batches, some at a time.

    Args:
        describer: the model.
        rows: the tokens of the images, by index.
        batches: the images that attend to each other.
        first: index of the first batch to describe.
        label: label of the progress bar.
        quiet: whether to hide the progress bar.
    """
    count, size = batches.images.shape
    # Batches of one descriptor each are computed together, as many as a batch has images.
    gives_one = batches.grouping in ("window", MASKED)
    step = max(1, min(size, count - first)) if gives_one else 1
    # The other groupings take little time compared with the backbone, and need no bar.
    silent = quiet or not gives_one
    with progress_bar(f"{label}, {batches.grouping}", count, "images", quiet=silent) as bar:
        for start in range(first, count, step):
            part = batches.part(start, start + step)
            # Groups are repeated in the last step, so that all steps run the same program.
            groups = np.resize(np.arange(len(part.images)), step)
            distinct, places = np.unique(part.images, return_inverse=True)
            tokens = rows[distinct][places.reshape(part.images.shape)[groups]]
            found = describer.attend(tokens, part.attention_mask[groups])[: len(part.images)]
            yield part.images[part.kept], found[part.kept]
            bar.advance(int(part.kept.sum()))


class FrameDescriber:
    """A describer of images as they arrive, each with the `window - 1` images before it."""

    def __init__(self, describer: Describer, window: int = 1) -> None:
        """Start without an image.

        Raises:
            InputError: the window is below 1, or above 1 for a model whose images do not attend to
                each other.
        """
        # An engine's configuration needs JAX, which takes a second to import.
        attends = window == 1 or describer.config.cross_image.attends
        if window < 1 or not attends:
            expected = "at least 1" if attends else "1 for a model without a cross-image encoder"
            raise InputError(f"window: found {window}, expected {expected}")
        self._describer, self._window = describer, window
        self.forget()

    def __call__(self, image: np.ndarray) -> Float32[np.ndarray, "1 d"]:
        """Describe the next image: 8-bit RGB or grey, of any size.

        Raises:
            InputError: `prepare_image` does not accept the image.
        """
        one = self._describer.preparation.prepare(image)[None]
        number, valid = np.zeros(1, int), np.ones(1, bool)
        ((rows, _),) = self._describer.tokens([ImageBatch(one, number, valid, number)])
        return self.of_tokens(rows)

    def of_tokens(self, rows: Rows) -> Float32[np.ndarray, "n d"]:
        """Describe the next images, given their tokens."""
        held = np.concatenate([*self._before, rows])
        first = len(held) - len(rows)
        self._before = [held[max(0, len(held) - self._window + 1) :]]
        batches = batches_of(len(held), "window", self._window)
        return group(self._describer, held, batches, first=first)[first:]

    def forget(self) -> None:
        """Forget all images so far."""
        self._before: list[Rows] = []
