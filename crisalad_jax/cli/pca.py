"""`crisalad pca`."""

import dataclasses
import pathlib
from typing import Annotated, Any

from crisalad_jax.checkpoints.load import load
from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.cli.common import echo, pick
from crisalad_jax.cli.flags import WEIGHTS, JsonFlag, QuietFlag
from crisalad_jax.config.checks import require
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.retrieval.descriptor_files import MADE_BY, open_npy, read_record
from crisalad_jax.retrieval.pca import SAMPLES, PcaConfig, fit_pca, save_pca, shortened


class Pca(JsonFlag, QuietFlag):
    """Fit principal components, with which extract and evaluate --pca shorten descriptors."""

    descriptors: pathlib.Path
    """A .npy file, such as `crisalad extract` writes, but not of evaluation images."""
    out: Annotated[pathlib.Path, WEIGHTS]
    """A .safetensors file: the components, or with --weights a model."""
    weights: str | None = None
    """Write this model, a file or a name, with the components as its last layer."""
    dim: int = 512
    """Number of components."""
    whiten: bool = False
    """Divide every component by its standard deviation."""
    renormalise: bool = True
    """Make the shorter descriptors unit vectors again."""
    samples: int = SAMPLES
    """Maximum number of descriptors to fit, drawn at random."""
    seed: int = 0
    """Seed of the draw of --samples."""
    checksums: bool = True
    """Check descriptors against their checksums; --no-checksums skips that for huge files."""


def run(arguments: Pca) -> dict[str, Any]:
    """Fit and write components, and print what variance they keep; return the result for --json."""
    weights = arguments.weights
    checked = {"verify": arguments.checksums}
    model = None if weights is None else load(weights, quiet=arguments.quiet, **checked)
    dim = model.config.projection.dim if model else 0
    require(not dim, f"{weights}: found a model with a projection to {dim} dimensions already")
    descriptors = open_npy(arguments.descriptors, **checked)
    made = read_record(arguments.descriptors)
    pca = fit_pca(
        descriptors,
        arguments.dim,
        PcaConfig(arguments.whiten, arguments.renormalise),
        model=made.get(MADE_BY, ""),
        name=str(arguments.descriptors),
        **pick(arguments, "samples", "seed", "quiet"),
    )
    if model is None:
        save_pca(arguments.out, pca)
    else:
        shortened(pca, describer_of(model), str(weights))
        layer, projection = pca.projection()
        params = dataclasses.replace(model.params, projection=layer)
        config = dataclasses.replace(model.config, projection=projection)
        save_weights(arguments.out, Model(params, config))
    fitted = min(arguments.samples, len(descriptors))
    echo(
        f"{arguments.out}: {arguments.dim} of {descriptors.shape[1]} components, "
        f"{100 * pca.kept:.1f} % of the variance of {fitted} descriptors"
    )
    return {
        "out": str(arguments.out),
        "components": arguments.dim,
        "of": descriptors.shape[1],
        "variance": float(pca.kept),
        "descriptors": fitted,
    }
