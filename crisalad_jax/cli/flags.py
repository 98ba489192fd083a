"""Flags that several commands share."""

import dataclasses
import functools
import pathlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple, dataclass_transform

from crisalad_jax.utils.files import check_folder, check_new_folder, check_target

if TYPE_CHECKING:  # commands that load no model of a file start without these
    from crisalad_jax.data.reading import Reading
    from crisalad_jax.nn.config import ModelConfig

RuntimeName = Literal["jax", "onnxruntime", "openvino"]
QueryRuntimeName = Literal["auto", "jax", "onnxruntime", "openvino"]
"""Engine that runs a model: JAX, another (`checkpoints.engines.EngineName`), or the fastest."""


class Target(NamedTuple):
    """Mark in the annotation of a flag that names an output, which is checked before any work."""

    suffixes: tuple[str, ...] = ()
    """Suffixes that the file's name may have; empty allows any."""
    check: Callable[[pathlib.Path], None] = check_target


WEIGHTS = Target(check=functools.partial(check_target, suffix=".safetensors"))
FOLDER = Target(check=check_folder)
NEW_FOLDER = Target(check=check_new_folder)


@dataclass_transform(
    frozen_default=True, kw_only_default=True, field_specifiers=(dataclasses.field,)
)
class Flags:
    """Base class of the flags of commands; subclasses become frozen dataclasses."""

    def __init_subclass__(cls) -> None:
        """Make the class a dataclass."""
        dataclasses.dataclass(frozen=True, kw_only=True)(cls)


class JsonFlag(Flags):
    """Flag for JSON output."""

    json: Annotated[pathlib.Path | None, Target((".json",))] = None
    """File for the result as JSON; - prints it instead."""


class TableFlags(JsonFlag):
    """Flags for JSON and LaTeX output."""

    latex: Annotated[pathlib.Path | None, Target((".tex",))] = None
    """File for the tables as LaTeX (package booktabs); - prints them."""


class PluginFlag(Flags):
    """Flag for plug-ins."""

    plugin: tuple[str, ...] = ()
    """Files FILE.py or modules that register custom parts or models; their code is run."""


class QuietFlag(Flags):
    """Flag that hides progress."""

    quiet: bool = False
    """Hide progress bars."""


class DecodeFlags(PluginFlag, QuietFlag):
    """Flags for the largest image file, the batch size, progress and plug-ins."""

    max_pixels: int = 2**28
    """Maximum pixels of an image file; larger ones are not decoded."""
    batch_size: int = 16
    """Number of images described together."""


class ReadFlags(DecodeFlags):
    """Flags for reading images, including unreadable ones."""

    on_bad_image: Literal["stop", "skip"] = "stop"
    """Stop at an unreadable image, or leave it out and report it."""

    @property
    def reading(self) -> "Reading":
        """These flags as a `Reading`, which the library takes."""
        from crisalad_jax.data.reading import Reading

        return Reading(batch_size=self.batch_size, on_bad_image=self.on_bad_image, quiet=self.quiet)


class ClusterFlag(Flags):
    """Flag for a Ray cluster."""

    cluster: str | None = None
    """Ray cluster that does the work: local, auto, ray://HOST[:PORT] or HOST:PORT
    (docs/how-to/ray.md)."""


class FrameFlags(Flags):
    """Flags that choose frames of videos and robot logs."""

    fps: float | None = None
    """Frames per second from a video or robot log, by default 1."""
    topic: str | None = None
    """Topic of images in a robot log (ROS bag), by default the only one."""


class SizeFlags(Flags):
    """Flags for image size and resizing."""

    image_size: tuple[int, int] | None = None
    """Height and width, multiples of the patch size; by default the model's, or the map's."""
    resize: tuple[str, ...] = ()
    """Resize settings that replace the model's: fixed, shorter-side, longer-side or native;
    bilinear, bicubic or area; antialias or no-antialias; bytes or floats; round;
    high-byte or contrast-stretch, for 16 bits and floats (docs/resizing.md)."""

    def applied_to(self, config: "ModelConfig") -> "ModelConfig":
        """Return a model's configuration with these flags applied."""
        return config.resized(self.image_size, self.resize)


class ComputeFlags(SizeFlags):
    """Flags for image size, resizing and compute type."""

    compute_dtype: Literal["float32", "bfloat16"] | None = None
    """Type of the matrix products, by default the model's, or the map's; docs/performance.md shows
    the effects of bfloat16."""

    def applied_to(self, config: "ModelConfig") -> "ModelConfig":
        """Return a model's configuration with these flags applied."""
        if self.compute_dtype is not None:
            config = dataclasses.replace(config, compute_dtype=self.compute_dtype)
        return super().applied_to(config)


class ModelFlags(ComputeFlags, QuietFlag):
    """Flags that choose the model and how it runs."""

    weights: pathlib.Path | None = None
    """By default starter, the small model in this package. Otherwise a .safetensors file, a
    published model's name (`crisalad models`), hf://OWNER/NAME on Hugging Face's hub, or an
    untrained baseline: hog or thumbnail."""
    runtime: RuntimeName = "jax"
    """Engine that runs the model (docs/export.md). Weights are exported for it once; --weights may
    be an exported folder."""
    checksums: bool = True
    """Check all files against their checksums; --no-checksums skips that for huge files."""


class MapFlags(Flags):
    """Flags that choose the map and its model."""

    map: pathlib.Path
    """Folder that `crisalad index` wrote."""
    weights: pathlib.Path | None = None
    """Model that made the map: a file or a published name; by default at its recorded path."""
    checksums: bool = True
    """Check the map's descriptors, and an exported model, against their checksums; --no-checksums
    skips that for huge files."""


class PositionFlags(Flags):
    """Flags for the positions of images."""

    positions: pathlib.Path | None = None
    """CSV of name,lat,lon or name,east,north or name,x,y (metres), for new images; or a track: GPX,
    GeoJSON, or CSV of time,lat,lon. By default from a table given as --images, @UTM names, or EXIF
    data (docs/how-to/image-sources.md)."""
    start_time: str | None = None
    """With a track as --positions: when the video began, as in 2026-05-01T12:00:00+02:00."""
    time_offset: float | None = None
    """With a track as --positions: seconds to add to the times of images, as in -7200 if the
    camera's clock is two hours ahead of UTC."""


class PlaceFlags(PositionFlags):
    """Flags for the positions of images and the distance between them."""

    every_metres: float | None = None
    """Take an image only if it is at least this far from the last one taken from its folder or
    video; images without a position are always taken."""


class SetFlags(Flags):
    """Flags for the evaluation set and its positives."""

    data: pathlib.Path
    """Evaluation set in any layout of docs/datasets.md: @UTM names, VPR-Bench, raw MSLS, two plain
    folders; a .mat file of NetVLAD; .npy lists of SALAD."""
    split: str | None = None
    """train, val or test, if the set has several."""
    layout: str | None = None
    """utm, vpr-bench, netvlad, salad, msls, msls-subtask or folders; by default detected
    from DATA (but not msls-subtask, the 740 queries of raw MSLS)."""
    images: pathlib.Path | None = None
    """Folder of the images that a .mat file or .npy lists name; by default the file's folder."""
    queries: str | None = None
    """Folder of the queries, if a @UTM set has several, such as queries_night of SVOX; by default
    queries."""
    ignore_zones: bool = False
    """Compare @UTM coordinates of all zones as if on one plane, as the public tools do."""
    radius: float | None = None
    """Largest distance of a positive in metres; by default 25, or that of a .mat file."""
    max_heading_difference: float | None = None
    """Largest heading difference of a positive in degrees, for raw MSLS; by default any (40 in the
    CriSALAD paper)."""
    frames: int | None = None
    """Largest distance of a positive in frames, for two plain folders with matching frames."""
