"""What several tests of pictures take."""

import pathlib

import cv2
import numpy as np
import pytest


@pytest.fixture
def photographs(tmp_path: pathlib.Path) -> dict[str, list[pathlib.Path]]:
    """Six database pictures and four queries, each of one blue-grey level, 60 x 80."""
    files = {}
    for part, count in (("database", 6), ("queries", 4)):
        files[part] = [tmp_path / part / f"{number}.png" for number in range(count)]
        (tmp_path / part).mkdir()
        for number, file in enumerate(files[part]):
            cv2.imwrite(str(file), np.full((60, 80, 3), (90, 20 * number + 60, 60), np.uint8))
    return files
