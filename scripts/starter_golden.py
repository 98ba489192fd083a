"""Keep what the model in the package says of two pictures, for machines that come later to compare.

    python scripts/starter_golden.py

Run it when the weights change, and commit what it writes: parity/goldens/starter.npz.
"""

import pathlib

import numpy as np

from crisalad_jax.checkpoints import starter
from crisalad_jax.checkpoints.load import load
from crisalad_jax.nn.model import describe
from crisalad_jax.retrieval.describe import prepare_image
from crisalad_jax.synthetic import View, render
from crisalad_jax.utils.files import atomic_path

GOLDEN = pathlib.Path(__file__).parents[1] / "parity" / "goldens" / "starter.npz"


def main() -> None:
    images = [render(7, View(), (60, 80), scenery) for scenery in ("street", "corridor")]
    params, config = load(starter.FILE)
    prepared = np.stack([prepare_image(image, config) for image in images])
    descriptors = np.asarray(describe(params, prepared, config))
    with atomic_path(GOLDEN) as path:
        np.savez_compressed(path, images=np.stack(images), descriptors=descriptors)
    print(f"{GOLDEN}: {' x '.join(map(str, descriptors.shape))} numbers")


if __name__ == "__main__":
    main()
