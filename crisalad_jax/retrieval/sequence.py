"""Sequence evidence: a discrete Bayes filter over the images of a map, in their order.

The state is the number of the image at which the camera is. Frames of a query come one after the
other; each moves the belief by a model of motion, and weighs it by the similarities of the frame
to all images. Where it is known when or where images and frames were taken, motion is in seconds or
metres, so that the two may have any frame rates. The idea is of Xu, Suenderhauf and Milford 2021,
"Probabilistic Visual Place Recognition for Hierarchical Localization" (RA-L); the likelihood here
is another one.
"""

import dataclasses
from typing import ClassVar, NamedTuple

import numpy as np

from crisalad_jax.config.checks import check_types, require, require_field
from crisalad_jax.config.short_repr import brief
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Float, Float64, Int64

PerPlace = Float[np.ndarray, " place"]
"""A number for each image of a map, float64 in a `SequenceState`."""
_PRIOR_FRAMES = 10
"""Number of frames that the map's own mean counts for in the mean of the frames so far."""
_ROUNDING = 5e-4
"""Seconds or metres that rounding may hide: videos' times are in whole milliseconds."""


@brief
class SequenceState(NamedTuple):
    """What a filter knows after some frames."""

    belief: PerPlace
    """Probability that the camera is at each image of the map."""
    common: PerPlace
    """Similarity of each image to the mean descriptor of the map."""
    seen: PerPlace
    """Sum of the similarities of the frames so far to each image."""
    frames: int
    """Number of frames so far."""
    along: PerPlace
    """How far along the map each image is: its number, or seconds or metres."""


@dataclasses.dataclass(frozen=True)
class BayesFilter:
    """A discrete Bayes filter over the images of a map, for consecutive frames of one camera.

    Motion: the camera moves along the map at most `reach` times as fast as the map's own camera
    did, either way, to each image as likely, and always as far as the next image; with probability
    `jump` it may be anywhere. By default a frame counts as an image of the map; where times or
    distances are known, `reach` is seconds of the map a second, or metres a metre. Evidence: the
    likelihood of an image is exp(`sharpness` * z), where z is its similarity to the frame in
    standard deviations from the mean over the map. So it does not depend on how close together a
    model's similarities lie.

    Where `adapt` is true, similarities are those of descriptors from which the mean of their side
    was taken: of the map, and of the frames so far. That takes away what all frames of a day have
    in common, such as its light (Schubert, Neubert and Protzel 2020, "Unsupervised Learning Methods
    for Visual Place Recognition in Discretely and Continuously Changing Environments", ICRA). The
    map's mean counts for ten frames in the second mean, until more are there.

    Args:
        reach: how far the camera moves at most: images of the map a frame, or seconds a second, or
            metres a metre.
        jump: probability that a frame is anywhere, above 0 and below 1.
        sharpness: weight of a frame against the frames before it.
        adapt: whether the mean of each side is taken away.

    Raises:
        InputError: a number out of range.

    Example:
        >>> import numpy as np
        >>> places = np.eye(5)  # descriptors of five images that have nothing in common
        >>> frames = places[[1, 2, 3]]
        >>> common = places @ places.mean(axis=0)
        >>> BayesFilter(reach=1).follow(frames @ places.T, common).places
        array([1, 2, 3])
    """

    counts_images: ClassVar[bool] = False
    """Whether motion is in images of the map whatever is known of times and positions."""
    reach: float = 2.0
    jump: float = 0.01
    sharpness: float = 2.0
    adapt: bool = True

    def __post_init__(self) -> None:
        """Check the types and ranges."""
        check_types(self)
        require_field(self, "reach", 1 <= self.reach < np.inf, "at least 1")
        require_field(self, "jump", 0 < self.jump < 1, "above 0 and below 1")
        require_field(self, "sharpness", 0 < self.sharpness < np.inf, "above 0")

    def start(self, common: PerPlace, along: PerPlace | None = None) -> SequenceState:
        """Begin a sequence anywhere in a map.

        Args:
            common: similarity of each image to the mean descriptor of the map.
            along: how far along the map each image is, in seconds or metres, never less than the
                image before; None counts images.

        Returns:
            The state before the first frame.

        Raises:
            InputError: no places, a similarity that is not finite, or `along` of another length,
                or that decreases.
        """
        common = checked("common", common, (max(1, np.size(common)),))
        count = len(common)
        along = np.asarray(np.arange(count) if along is None else along, np.float64)
        rises = along.shape == common.shape and bool((np.diff(along) >= 0).all())
        require(rises, f"along: found shape {along.shape}, expected {common.shape}, ascending")
        return SequenceState(np.full(count, 1 / count), common, np.zeros(count), 0, along)

    def predict(self, state: SequenceState, moved: float = 1.0) -> PerPlace:
        """Move a belief from one frame to the next, by the model of motion.

        Args:
            state: after the frame before.
            moved: as in `step`.

        Returns:
            The probability that the camera is at each image, before the next frame is looked at.
        """
        along, far = state.along, self.reach * moved + _ROUNDING
        numbers = np.arange(len(along))
        # The next image is in reach however far it is, or a camera could never leave a gap.
        first = np.minimum(np.searchsorted(along, along - far), numbers - 1).clip(0)
        end = np.maximum(np.searchsorted(along, along + far, "right"), numbers + 2)
        end = end.clip(max=len(along))
        # At the ends of the map fewer images are in reach, which share what leaves an image.
        total = np.concatenate([[0.0], np.cumsum(state.belief / (end - first))])
        return (1 - self.jump) * (total[end] - total[first]) + self.jump / len(along)

    def step(
        self, state: SequenceState, similarities: PerPlace, moved: float = 1.0
    ) -> SequenceState:
        """Take the next frame into account.

        Args:
            state: after the frame before.
            similarities: of the frame to every image of the map: cosines of descriptors.
            moved: seconds or metres since the frame before, as the map's `along` is in; infinity
                where that is unknown. Of a map that counts images, frames.

        Returns:
            The state after this frame.

        Raises:
            InputError: `moved` below 0, or similarities that are not one finite number a place.
        """
        require(moved >= 0, f"moved: found {moved}, expected at least 0")
        row = checked("similarities", similarities, state.common.shape)
        seen, frames = state.seen + row, state.frames + 1
        if self.adapt:
            mean = (seen + _PRIOR_FRAMES * state.common) / (frames + _PRIOR_FRAMES)
            row = _without_means(row, mean, state.common)
        deviation = row.std()
        evidence = self.sharpness * (row - row.max()) / (deviation if deviation > 0 else 1)
        belief = self.predict(state, moved) * np.exp(evidence)
        return state._replace(belief=belief / belief.sum(), seen=seen, frames=frames)

    def follow(
        self,
        similarities: Float[np.ndarray, "frame place"],
        common: PerPlace,
        along: PerPlace | None = None,
        moved: Float[np.ndarray, " frame"] | None = None,
    ) -> "Followed":
        """Follow a camera through all frames of a sequence.

        Args:
            similarities: of every frame, in order, to every image of the map.
            common: as in `start`.
            along: as in `start`.
            moved: of every frame, as in `step`; None is a frame each.

        Returns:
            The best place at each frame, from this frame and those before it.

        Raises:
            InputError: `moved` of another number of frames, or what `start` and `step` raise.
        """
        state, places, probabilities = self.start(common, along), [], []
        steps = np.ones(len(similarities)) if moved is None else np.asarray(moved)
        frames = (len(similarities),)
        require(steps.shape == frames, f"moved: found shape {steps.shape}, expected {frames}")
        for row, step in zip(similarities, steps, strict=True):
            state = self.step(state, row, float(step))
            places.append(int(state.belief.argmax()))
            probabilities.append(state.belief.max())
        return Followed(np.array(places, np.int64), np.array(probabilities))


@brief
class Followed(NamedTuple):
    """Where a camera was at each frame of a sequence."""

    places: Int64[np.ndarray, " frame"]
    """Number of the most probable image of the map."""
    probabilities: Float64[np.ndarray, " frame"]
    """Probability that the camera is there; images beside it share what they have in common."""


def checked(name: str, values: PerPlace, shape: tuple[int, ...]) -> PerPlace:
    """Return finite numbers of this shape, in float64; raise InputError where they are others."""
    if np.shape(values) != shape or not np.isfinite(values).all():
        found = f"shape {np.shape(values)}" if np.shape(values) != shape else "NaN or infinity"
        raise InputError(f"{name}: found {found}, expected shape {shape} of finite numbers")
    return np.asarray(values, np.float64)


def _without_means(row: PerPlace, mean: PerPlace, common: PerPlace) -> PerPlace:
    """Compute similarities of a frame without its side's mean to images without the map's.

    With unit descriptors d of the map, their mean m, a frame q and the mean f of the frames, it is
    (d - m) . (q - f) / |d - m|. No descriptor is needed: `row` is d . q, `mean` d . f, `common`
    d . m, and the average over the map of each of the three is its product with m.
    """
    products = (row - row.mean()) - (mean - mean.mean())
    lengths = np.sqrt(np.maximum(1 - 2 * common + common.mean(), 0))
    return products / np.maximum(lengths, 1e-6)  # an image that is the mean itself says nothing
