"""How a photograph becomes a network's input: its size, filter and normalisation."""

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
"""How colours of more than 8 bits become 8-bit ones."""
LocalFeatures = Literal["sift", "orb"]
"""Local features that can replace the pixels of photographs."""
FEATURE_BYTES: Mapping[str, int] = {"sift": 129, "orb": 33}
"""Bytes of a local feature: its descriptor's, and a last one that is 0 if there is no feature."""
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
"""Values of the flag --resize, and the fields that they set."""


@short_repr(switch=("normalisation", "local-contrast", "mean", "deviation"))
@dataclasses.dataclass(frozen=True)
class PreprocessingConfig:
    """How a photograph becomes a network's input.

    Published models differ in it, and another filter changes a descriptor by 1e-3 to 6e-2. The
    defaults are torchvision's chain on Pillow images: `Resize`, `ToTensor`, `Normalize`.

    Normalising before or after resizing is the same: the resize is linear; its weights sum to 1.

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
    enlarges, and "native" leaves images as they are. Their sides are then rounded to the nearest
    multiples of the patch size, if the backbone takes no others."""
    filter: Literal["bilinear", "bicubic", "area"] = non_semantic_field("bilinear")
    """Filter of the resize; "area" is OpenCV's INTER_AREA, which hloc uses."""
    antialias: bool = non_semantic_field(True)
    """Whether the filter widens when an image shrinks, as Pillow's always does."""
    pixels: Literal["bytes", "floats"] = non_semantic_field("bytes")
    """What is resized: "bytes" are rounded after each pass, as Pillow does; "floats" are neither
    rounded nor clamped, as torch does."""
    round_to_patch: bool = non_semantic_field(False)
    """Whether images of a fixed size that is not a multiple of the patch size are resized again,
    to the nearest one (halves to even), bilinear and antialiased. MegaLoc does so."""
    bit_depth: BitDepth = non_semantic_field("high-byte")
    """How deeper colours become 8-bit, before the resize. "high-byte" drops the low byte of 16
    bits. "contrast-stretch" spreads each image's own values, from the 1st to the 99th percentile,
    over 0 to 255: for thermal images, whose values fill a small part of 16 bits, and for floats.
    8-bit images do not change."""
    normalisation: Literal["mean-deviation", "local-contrast"] = "mean-deviation"
    """How pixels are normalised: by `mean` and `deviation`, or by those of each neighbourhood."""
    mean: tuple[float, float, float] = IMAGENET_MEAN
    """Mean of red, green and blue, for pixels from 0 to 1; by default ImageNet's."""
    deviation: tuple[float, float, float] = IMAGENET_DEVIATION
    """Divisor of pixels from 0 to 1 minus the mean; by default ImageNet's. A network that takes
    pixels from 0 to 255 minus a mean, such as hloc's NetVLAD, has a deviation of 1/255."""

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
            image_size: height and width of the model, `ModelConfig.image_size`.

        Returns:
            Height and width in pixels. "shorter-side" truncates the other side, as torchvision
            does; "longer-side" rounds it, as hloc does.

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
        """Round sides to the nearest multiples, if sides are to be rounded.

        Args:
            size: height and width of `target_size`.
            side_multiple: number of pixels that sides have to be multiples of.

        Returns:
            Height and width of the network's input.

        Example:
            >>> PreprocessingConfig(size_rule="native").rounded_size((240, 320), 14)
            (238, 322)
        """
        if not self.rounds:
            return size
        height, width = (max(1, round(side / side_multiple)) * side_multiple for side in size)
        return height, width

    def for_training(self) -> "PreprocessingConfig":
        """Return the chain for training: the same filter by Pillow's rules, at a fixed size.

        All published training loaders resize Pillow images: bytes, antialiased.
        """
        return dataclasses.replace(self, size_rule="fixed", pixels="bytes", antialias=True)

    def changed_by(self, words: Sequence[str]) -> "PreprocessingConfig":
        """Return this chain with the fields set by values of --resize (see `WORDS`).

        Raises:
            InputError: an unknown value, two for one field, or one without effect.

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
        """Describe the resize of a model of this image size in a few words.

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
