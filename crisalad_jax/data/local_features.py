"""Hand-crafted local features of photographs by OpenCV, encoded as the bytes of an image."""

import cv2
import numpy as np

from crisalad_jax.config.preprocessing import FEATURE_BYTES, LocalFeatures
from crisalad_jax.utils.shapes import UInt8


def encode_local_features(
    image: UInt8[np.ndarray, "h w 3"], kind: LocalFeatures, count: int
) -> UInt8[np.ndarray, "count third 3"]:
    """Return the strongest local features of a photograph, by OpenCV with its default settings.

    Args:
        image: 8-bit RGB.
        kind: "sift" (Lowe, IJCV 2004), of 128 values from 0 to 255; or "orb" (Rublee et al., ICCV
            2011), of 256 bits.
        count: number of rows; if fewer features are found, the remaining rows are 0.

    Returns:
        uint8 (count, `FEATURE_BYTES[kind]` / 3, 3): a row of bytes per feature, strongest first.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    detector = (cv2.SIFT if kind == "sift" else cv2.ORB).create(nfeatures=count)
    points, found = detector.detectAndCompute(grey, None)  # pyright: ignore
    rows = np.zeros((count, FEATURE_BYTES[kind]), np.uint8)
    if found is not None:
        # OpenCV returns all features that are as strong as the last one.
        strongest = np.argsort([-point.response for point in points], kind="stable")[:count]
        rows[: len(strongest), :-1] = found[strongest]
        rows[: len(strongest), -1] = 1
    return rows.reshape(count, -1, 3)
