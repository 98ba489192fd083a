"""`crisalad pca`."""

import dataclasses
import pathlib

from crisalad_jax.cli.common import say
from crisalad_jax.retrieval.descriptor_files import open_npy
from crisalad_jax.retrieval.pca import SAMPLES, PcaConfig, fit_pca, save_pca
from crisalad_jax.utils.files import check_target


@dataclasses.dataclass(frozen=True)
class Pca:
    """Fit principal components to descriptors, for shorter ones (extract, evaluate --pca)."""

    descriptors: pathlib.Path
    """A .npy file, such as `crisalad extract` writes; not of images that are evaluated on."""
    out: pathlib.Path
    """A .safetensors file."""
    dim: int = 512
    """Components that are kept."""
    whiten: bool = False
    """Divide every component by its standard deviation."""
    renormalise: bool = True
    """Make the shorter descriptors unit vectors again."""
    samples: int = SAMPLES
    """Fit at most so many descriptors, drawn at random."""
    seed: int = 0
    """Draws them."""
    verify: bool = True
    """Check descriptors against their checksums; --no-verify skips that, where files are huge."""
    quiet: bool = False
    """No progress bar."""


def run(arguments: Pca) -> None:
    """Fit components, write them, and print their share of the variance."""
    check_target(arguments.out, ".safetensors")
    descriptors = open_npy(arguments.descriptors, verify=arguments.verify)
    pca = fit_pca(
        descriptors,
        arguments.dim,
        PcaConfig(arguments.whiten, arguments.renormalise),
        samples=arguments.samples,
        seed=arguments.seed,
        name=str(arguments.descriptors),
        quiet=arguments.quiet,
    )
    save_pca(arguments.out, pca)
    say(
        f"{arguments.out}: {arguments.dim} of {descriptors.shape[1]} components, "
        f"{100 * pca.kept:.1f} % of the variance of "
        f"{min(arguments.samples, len(descriptors))} descriptors"
    )
