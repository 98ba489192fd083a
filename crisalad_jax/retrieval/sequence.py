"""Sequence evidence: a discrete Bayes filter over the images of a map, in their order.

The state is the index of the image at which the camera is. The frames of a query arrive in order;
each moves the belief by a motion model, and weights it by the similarities of the frame to all
images. If the times or positions of images and frames are known, motion is in seconds or metres, so
their frame rates may differ. The idea is from Xu, Suenderhauf and Milford 2021, "Probabilistic
Visual Place Recognition for Hierarchical Localization" (RA-L); the likelihood is a different one.
"""

import dataclasses
from typing import ClassVar, NamedTuple

import numpy as np

from crisalad_jax.config.checks import check_types, require, require_field
from crisalad_jax.config.short_repr import brief
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.shapes import Float, Float64, Int64

PerPlace = Float[np.ndarray, " place"]
"""A value for each image of a map, float64 in a `SequenceState`."""
_PRIOR_FRAMES = 10
"""Weight of the map's mean in the mean of the frames so far, as a number of frames."""
_ROUNDING = 5e-4
"""Tolerance for rounding, in seconds or metres: video times are in whole milliseconds."""


@brief
class SequenceState(NamedTuple):
    """The state of a filter after some frames."""

    belief: PerPlace
    """Probability that the camera is at each image of the map."""
    common: PerPlace
    """Similarity of each image to the mean descriptor of the map."""
    seen: PerPlace
    """Sum, over the frames so far, of their similarities to each image."""
    frames: int
    """Number of frames so far."""
    along: PerPlace
    """How far along the map each image is: its index, or seconds or metres."""


@dataclasses.dataclass(frozen=True)
class BayesFilter:
    """A discrete Bayes filter over the images of a map, for consecutive frames of one camera.

    Motion: the camera moves along the map in either direction, at most `reach` times as fast as the
    camera of the map did. All images within reach are equally likely, and the next image is always
    within reach; with probability `jump` the camera may be anywhere. By default, `reach` is in
    images of the map per frame; if times or distances are known, it is in seconds of the map per
    second, or metres per metre. Evidence: the likelihood of an image is exp(`sharpness` * z), where
    z is its similarity to the frame in standard deviations from the mean over the map, so it does
    not depend on how close together the similarities of a model are.

    If `adapt` is true, the mean descriptor of each side (map, frames so far) is subtracted from its
    descriptors. This removes what all frames of a day have in common, such as its light (Schubert,
    Neubert and Protzel 2020, "Unsupervised Learning Methods for Visual Place Recognition in
    Discretely and Continuously Changing Environments", ICRA). In the mean of the frames, the mean
    of the map counts as ten frames.

    Args:
        reach: the largest motion of the camera, in the units described above.
        jump: probability that the camera jumps to any image, above 0 and below 1.
        sharpness: weight of a frame relative to the frames before it.
        adapt: whether to subtract the mean of each side.

    Raises:
        InputError: a number is out of range.

    Example:
        >>> import numpy as np
        >>> places = np.eye(5)  # descriptors of five images that have nothing in common
        >>> frames = places[[1, 2, 3]]
        >>> common = places @ places.mean(axis=0)
        >>> BayesFilter(reach=1).follow(frames @ places.T, common).places
        array([1, 2, 3])
    """

    counts_images: ClassVar[bool] = False
    """Whether motion is in images of the map, even if times and positions are known."""
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
        """Start a sequence, with the same belief in all images of a map.

        Args:
            common: similarity of each image to the mean descriptor of the map.
            along: how far along the map each image is, in seconds or metres, never decreasing;
                None counts images.

        Returns:
            The state before the first frame.

        Raises:
            InputError: there are no images, a similarity is not finite, or `along` decreases or has
                another length.
        """
        common = checked("common", common, (max(1, np.size(common)),))
        count = len(common)
        along = np.asarray(np.arange(count) if along is None else along, np.float64)
        rises = along.shape == common.shape and bool((np.diff(along) >= 0).all())
        require(rises, f"along: found shape {along.shape}, expected {common.shape}, ascending")
        return SequenceState(np.full(count, 1 / count), common, np.zeros(count), 0, along)

    def predict(self, state: SequenceState, moved: float = 1.0) -> PerPlace:
        """Predict the belief before the next frame, by the motion model.

        Args:
            state: state after the previous frame.
            moved: seconds, metres or frames since the previous frame, as in `step`.

        Returns:
            The probability that the camera is at each image, before the next frame is seen.
        """
        along, far = state.along, self.reach * moved + _ROUNDING
        numbers = np.arange(len(along))
        # The next image is always in reach, or a camera could never cross a gap.
        first = np.minimum(np.searchsorted(along, along - far), numbers - 1).clip(0)
        end = np.maximum(np.searchsorted(along, along + far, "right"), numbers + 2)
        end = end.clip(max=len(along))
        # At the ends of the map, fewer images are in reach to share the probability of an image.
        total = np.concatenate([[0.0], np.cumsum(state.belief / (end - first))])
        return (1 - self.jump) * (total[end] - total[first]) + self.jump / len(along)

    def step(
        self, state: SequenceState, similarities: PerPlace, moved: float = 1.0
    ) -> SequenceState:
        """Update the state with the next frame.

        Args:
            state: state after the previous frame.
            similarities: cosine similarities of the frame to every image of the map.
            moved: seconds or metres since the previous frame, as in the map's `along`, or frames
                for a map that counts images; infinity if unknown.

        Returns:
            The state after this frame.

        Raises:
            InputError: `moved` is below 0, or `similarities` is not one finite number per image.
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
            similarities: similarities of every frame, in order, to every image of the map.
            common: similarity of each image to the mean descriptor of the map.
            along: how far along the map each image is, as in `start`.
            moved: motion before each frame, as in `step`; None is 1 for each.

        Returns:
            The most probable image at each frame, given that frame and those before it.

        Raises:
            InputError: `moved` has another length, or `start` or `step` refuses an argument.
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
    """Index of the most probable image of the map."""
    probabilities: Float64[np.ndarray, " frame"]
    """Probability that the camera is at this image. Similar images nearby divide the probability
    among themselves, so it can be low for each."""


def checked(name: str, values: PerPlace, shape: tuple[int, ...]) -> PerPlace:
    """Return values in float64; raise InputError if they are not finite or not of this shape."""
    if np.shape(values) != shape or not np.isfinite(values).all():
        found = f"shape {np.shape(values)}" if np.shape(values) != shape else "NaN or infinity"
        raise InputError(f"{name}: found {found}, expected shape {shape} of finite numbers")
    return np.asarray(values, np.float64)


def _without_means(row: PerPlace, mean: PerPlace, common: PerPlace) -> PerPlace:
    """Compute similarities of a frame to images, with the mean of each side subtracted.

    For unit descriptors d of the map, their mean m, a frame q and the mean f of the frames, that is
    (d - m) . (q - f) / |d - m|. No descriptor is needed: `row` is d . q, `mean` is d . f, `common`
    is d . m, and averaging each of the three over the map gives its product with m.
    """
    products = (row - row.mean()) - (mean - mean.mean())
    lengths = np.sqrt(np.maximum(1 - 2 * common + common.mean(), 0))
    return products / np.maximum(lengths, 1e-6)  # an image equal to the mean is no evidence
