"""Reading pictures back: where a colour stands."""

import cv2
import numpy as np

from crisalad_jax.experiments.report import save

GREEN = (0x2A, 0x8F, 0x3C)
RED = (0xC6, 0x28, 0x28)
BLUE = (0x00, 0x72, 0xB2)
ORANGE = (0xD5, 0x5E, 0x00)


def read_picture(path):
    return cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)


def drawn(figure, folder):
    """The pixels of a figure, written and read back."""
    save(figure, folder / "drawn.png")
    return read_picture(folder / "drawn.png")


def is_colour(picture, colour):
    return (picture == np.array(colour, np.uint8)).all(axis=-1)


def near_colour(picture, colour):
    # 40 grey levels: thin lines are blended with the white around them.
    return (np.abs(picture.astype(int) - colour) < 40).all(axis=-1)


def assert_clear_edges(picture):
    """Nothing touches them."""
    for edge in (picture[:4], picture[-4:], picture[:, :4], picture[:, -4:]):
        assert (edge == 255).all()


def boxes_of(picture, colour):
    """(left, top, width, height) of every frame of a colour; letters are narrower."""
    _, _, stats, _ = cv2.connectedComponentsWithStats(is_colour(picture, colour).astype(np.uint8))
    return sorted(tuple(map(int, s[:4])) for s in stats[1:] if s[2] > 40)
