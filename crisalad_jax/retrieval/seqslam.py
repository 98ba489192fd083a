"""SeqSLAM: locate a camera by a line of low differences between frames and a map's images.

Milford and Wyeth, ICRA 2012.
"""

import dataclasses
from typing import ClassVar, NamedTuple

import numpy as np

from crisalad_jax.config.checks import PositiveInt, check_types, require_field
from crisalad_jax.config.short_repr import brief
from crisalad_jax.retrieval.sequence import PerPlace, checked
from crisalad_jax.utils.shapes import Float, Float64


@brief
class SeqSlamState(NamedTuple):
    """The state of a SeqSLAM search after some frames."""

    belief: PerPlace
    """Belief that the camera is at each image of the map; sums to 1. See `SeqSlam`."""
    common: PerPlace
    """Similarity of each image to the mean descriptor of the map; not used."""
    rows: Float64[np.ndarray, "frame place"]
    """Enhanced differences between the last frames, oldest first, and all images."""
    frames: int
    """Number of frames so far."""


@dataclasses.dataclass(frozen=True)
class SeqSlam:
    """SeqSLAM (Milford and Wyeth, ICRA 2012), for consecutive frames of one camera.

    The difference between a frame and an image, one minus their similarity, is enhanced: the mean
    over the surrounding images is subtracted, and the result divided by their standard deviation.
    The score of an image is the smallest sum of enhanced differences along a line that ends at this
    image in the latest frame. Lines have velocities from `slowest` to `fastest` in steps of 0.1
    images of the map per frame, and are rounded to the nearest image; where a line would pass the
    first image, it stays there. Two things differ from the paper: the belief in an image is the
    softmax of its negative score, and images are compared by cosine rather than by sums of
    absolute differences of small, patch-normalised images (those of the model `thumbnail`).

    Args:
        length: number of latest frames that a line goes through.
        window: number of surrounding images, half on either side, for enhancing differences.
        slowest: lowest velocity, in images of the map per frame.
        fastest: highest velocity.

    Raises:
        InputError: a number is out of range.

    Example:
        >>> import numpy as np
        >>> places = np.eye(9)
        >>> state = (search := SeqSlam(length=3)).start(places.mean(axis=0))
        >>> for frame in places[[4, 5, 6]]:
        ...     state = search.step(state, places @ frame)
        >>> int(state.belief.argmax())
        6
    """

    counts_images: ClassVar[bool] = True
    length: PositiveInt = 10
    window: PositiveInt = 10
    slowest: float = 0.8
    fastest: float = 1.2

    def __post_init__(self) -> None:
        """Check the types and ranges."""
        check_types(self)
        require_field(self, "slowest", 0 <= self.slowest < np.inf, "at least 0")
        fits = self.slowest <= self.fastest < np.inf
        require_field(self, "fastest", fits, f"at least the slowest, {self.slowest}")

    @property
    def velocities(self) -> Float64[np.ndarray, " line"]:
        """The velocities of lines, in images of the map per frame."""
        steps = round((self.fastest - self.slowest) / 0.1)
        # Rounded, so that halves of an image are halves.
        return np.linspace(self.slowest, self.fastest, steps + 1).round(9)

    def start(self, common: PerPlace) -> SeqSlamState:
        """Start a sequence, with the same belief in all images of a map.

        Args:
            common: a value for each image; only their number is used.

        Raises:
            InputError: there are no images, or a value is not finite.
        """
        common = checked("common", common, (max(1, np.size(common)),))
        count = len(common)
        return SeqSlamState(np.full(count, 1 / count), common, np.empty((0, count)), 0)

    def step(self, state: SeqSlamState, similarities: PerPlace, moved: float = 1.0) -> SeqSlamState:
        """Update the state with the next frame.

        Args:
            state: state after the previous frame.
            similarities: cosine similarities of the frame to every image of the map.
            moved: not used, since velocities are per frame.

        Returns:
            The state after this frame.

        Raises:
            InputError: `similarities` is not one finite number per image.
        """
        differences = 1 - checked("similarities", similarities, state.common.shape)
        enhanced = self.enhance(differences)[None]
        rows = np.concatenate([state.rows, enhanced])[-self.length :]
        ages = np.arange(len(rows))[::-1, None]
        scores = np.full(len(differences), np.inf)
        for velocity in self.velocities:
            line = np.rint(np.arange(len(scores)) - velocity * ages).astype(int).clip(0)
            scores = np.minimum(scores, np.take_along_axis(rows, line, axis=1).sum(axis=0))
        belief = np.exp(scores.min() - scores)
        return SeqSlamState(belief / belief.sum(), state.common, rows, state.frames + 1)

    def enhance(self, differences: PerPlace) -> Float[np.ndarray, " place"]:
        """Enhance a frame's differences locally; windows are cut at both ends of the map."""
        side, count = self.window // 2, len(differences)
        first = (np.arange(count) - side).clip(0)
        end = (np.arange(count) + side + 1).clip(max=count)
        centred = differences - differences.mean()
        sums = np.concatenate([np.zeros((1, 2)), np.cumsum([centred, centred**2], axis=1).T])
        mean, square = ((sums[end] - sums[first]) / (end - first)[:, None]).T
        deviation = np.sqrt(np.maximum(square - mean**2, 0))
        # Below this, the differences are equal up to rounding.
        return (centred - mean) / np.where(deviation > 1e-7, deviation, np.inf)
