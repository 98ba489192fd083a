"""How a photograph becomes a network's input: size, resize filter and normalisation."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from crisalad_jax.config.checks import check_types, require
from crisalad_jax.config.part import non_semantic_field
from crisalad_jax.config.short_repr import short_repr

Size = tuple[int, int]
"""Height and width in pixels."""
BitDepth = Literal["high-byte", "contrast-stretch"]
"""Rule that reduces colours of more than 8 bits; see `PreprocessingConfig.bit_depth`."""
LocalFeatures = Literal["sift", "orb"]
"""Kinds of hand-crafted local features that can replace the pixels as a model's input."""
FEATURE_BYTES: Mapping[str, int] = {"sift": 129, "orb": 33}
"""Bytes per local feature, by kind: its descriptor, then one byte, which is 1, or 0 in padding."""
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_DEVIATION = (0.229, 0.224, 0.225)

WORDS: Mapping[str, Mapping[str, Any]] = {
    **{name: {"size_rule": name} for name in ("fixed", "shorter-side", "longer-side", "native")},
    **{name: {"filter": name} for name in ("bilinear", "bicubic", "area")},
    "antialias": {"antialias": True},
    "no-antialias": {"antialias": False},
    **{name: {"pixels": name} for name in ("bytes", "floats")},
    "round": {"round_to_patch": True},
    **{name: {"bit_depth": name} for name in ("high-byte", "contrast-stretch")},
}
"""Values of the flag `--resize`, and the fields of `PreprocessingConfig` that each sets."""


@short_repr(switch=("normalisation", "local-contrast", "mean", "deviation"))
@dataclasses.dataclass(frozen=True)
class PreprocessingConfig:
    """How a photograph is resized and normalised for a network.

    Published models differ in these settings, which change descriptors (docs/resizing.md). The
    defaults are torchvision's `Resize`, `ToTensor` and `Normalize` on Pillow images. With "floats"
    pixels, normalising before or after the resize is equivalent: the filter's weights sum to 1.

    Example:
        >>> chain = PreprocessingConfig(filter="bicubic", pixels="floats")
        >>> chain.target_size((480, 640), (322, 322))
        (322, 322)
    """

    size_rule: Literal["fixed", "shorter-side", "longer-side", "native"] = non_semantic_field(
        "fixed"
    )
    """Target size of an image. "fixed" is `ModelConfig.image_size`, whatever the aspect ratio. The
    others keep the aspect ratio: "shorter-side" resizes the shorter side to that of `image_size`,
    "longer-side" shrinks images until the longer side is at most that of `image_size` and never
    enlarges, and "native" leaves images as they are. Except under "fixed", sides are then rounded
    to the nearest multiples of the patch size, if the backbone needs such sides."""
    filter: Literal["bilinear", "bicubic", "area"] = non_semantic_field("bilinear")
    """Resize filter; "area" is OpenCV's INTER_AREA (if a side grows, INTER_LINEAR), as in hloc."""
    antialias: bool = non_semantic_field(True)
    """Whether the filter widens when an image shrinks, as in Pillow; no effect on "area"."""
    pixels: Literal["bytes", "floats"] = non_semantic_field("bytes")
    """Type of the resized pixels: "bytes" are rounded to 8 bits, as in Pillow; "floats" are neither
    rounded nor clamped, as in torch."""
    round_to_patch: bool = non_semantic_field(False)
    """Whether, under "fixed", a second resize (bilinear, antialiased) rounds each side to the
    nearest multiple of the patch size (halves to even), as MegaLoc does."""
    bit_depth: BitDepth = non_semantic_field("high-byte")
    """How colours of more than 8 bits are reduced to 8, before the resize. "high-byte" drops the
    low byte of 16 bits. "contrast-stretch" maps each image's 1st percentile to 0 and its 99th to
    255: for thermal images, whose values fill a small part of 16 bits, and for floats. 8-bit images
    do not change."""
    normalisation: Literal["mean-deviation", "local-contrast"] = "mean-deviation"
    """How pixels are normalised: by `mean` and `deviation`, or ("local-contrast") by the mean and
    deviation of the 21 x 21 pixels around each pixel."""
    mean: tuple[float, float, float] = IMAGENET_MEAN
    """Mean of red, green and blue, for pixels from 0 to 1; by default ImageNet's."""
    deviation: tuple[float, float, float] = IMAGENET_DEVIATION
    """Standard deviation of red, green and blue: pixels minus the mean are divided by it. By
    default ImageNet's; 1/255 if a network takes 0 to 255 minus a mean, as hloc's NetVLAD does."""

    def __post_init__(self) -> None:
        """Check the values."""
        check_types(self)
        if self.normalisation == "local-contrast":
            require(
                self.pixels == "bytes",
                f"PreprocessingConfig.pixels: found {self.pixels} with normalisation "
                f"{self.normalisation}, which is only for bytes, expected bytes",
            )
            return
        require(
            all(map(math.isfinite, (*self.mean, *self.deviation))) and min(self.deviation) > 0,
            f"PreprocessingConfig: found mean {self.mean} and deviation {self.deviation}, expected "
            "finite numbers, and deviations above 0",
        )

    @property
    def rounds(self) -> bool:
        """Whether sides are rounded to multiples of the patch size."""
        return self.round_to_patch or self.size_rule != "fixed"

    def target_size(self, size: Size, image_size: Size) -> Size:
        """Return the target size of an image under `size_rule`, before sides are rounded.

        Args:
            size: height and width of the image.
            image_size: height and width of the model's input, `ModelConfig.image_size`.

        Returns:
            Height and width in pixels. Fractions of a pixel are truncated for "shorter-side", as in
            torchvision, and rounded for "longer-side", as in hloc.

        Example:
            >>> rule = PreprocessingConfig(size_rule="shorter-side")
            >>> rule.target_size((480, 640), (512, 512))
            (512, 682)
        """
        if self.size_rule == "fixed":
            return image_size
        height, width = size
        shorter, longer = min(size), max(size)
        if self.size_rule == "shorter-side":
            short = min(image_size)
            long = int(short * longer / shorter)
            return (short, long) if height <= width else (long, short)
        most = max(image_size)
        if self.size_rule == "longer-side" and longer > most:
            scale = most / longer
            return max(1, round(height * scale)), max(1, round(width * scale))
        return height, width

    def rounded_size(self, size: Size, side_multiple: int) -> Size:
        """Return a size rounded to the nearest multiples of `side_multiple`, if `rounds` is True.

        Args:
            size: height and width in pixels, from `target_size`.
            side_multiple: number of pixels that sides have to be multiples of.

        Returns:
            Height and width of the network's input in pixels; `size` itself if `rounds` is False.

        Example:
            >>> PreprocessingConfig(size_rule="native").rounded_size((240, 320), 14)
            (238, 322)
        """
        if not self.rounds:
            return size
        height, width = (max(1, round(side / side_multiple)) * side_multiple for side in size)
        return height, width

    def for_training(self) -> "PreprocessingConfig":
        """Return this configuration with a fixed size, 8-bit pixels and antialiasing, for training.

        All published training loaders resize Pillow images, hence 8-bit pixels and antialiasing.
        """
        return dataclasses.replace(self, size_rule="fixed", pixels="bytes", antialias=True)

    def changed_by(self, words: Sequence[str]) -> "PreprocessingConfig":
        """Apply `words`, values of `--resize` (keys of `WORDS`); return the new configuration.

        Raises:
            InputError: a word is unknown, contradicts another word, or has no effect.

        Example:
            >>> PreprocessingConfig().changed_by(["native", "bicubic"]).filter
            'bicubic'
        """
        changes: dict[str, Any] = {}
        for word in words:
            require(word in WORDS, f"--resize: found {word!r}, expected some of {', '.join(WORDS)}")
            for field, value in WORDS[word].items():
                require(
                    changes.setdefault(field, value) == value,
                    f"--resize: found {' '.join(words)}, expected one of "
                    f"{', '.join(each for each, sets in WORDS.items() if field in sets)}",
                )
        changed = dataclasses.replace(self, **changes)
        require(
            "antialias" not in changes or changed.filter != "area",
            f"--resize: found {' '.join(words)}, expected neither antialias nor no-antialias with "
            "filter area, which has no such choice",
        )
        return changed

    def in_words(self, image_size: Size) -> str:
        """Describe the resize to `image_size` (height, width) in a few words.

        Example:
            >>> PreprocessingConfig().in_words((224, 224))
            '224 x 224, bilinear, antialiased, on bytes'
        """
        size = {
            "fixed": " x ".join(map(str, image_size)),
            "shorter-side": f"shorter side {min(image_size)}",
            "longer-side": f"longer side at most {max(image_size)}",
            "native": "native size",
        }[self.size_rule]
        if self.filter == "area":
            how = "area"
        else:
            how = f"{self.filter}, {'' if self.antialias else 'not '}antialiased"
        stretched = "" if self.bit_depth == "high-byte" else f", {self.bit_depth}"
        return f"{size}, {how}, on {self.pixels}{stretched}"
