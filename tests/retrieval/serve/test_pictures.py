"""Which pictures are decoded, and that large ones hold up no small ones."""

import concurrent.futures
import io
import threading

import cv2
import numpy as np
import pytest
from PIL import Image

from crisalad_jax.retrieval.serve import app
from tests.retrieval.serve.conftest import serving


def saved(width: int, height: int, kind: str, **options: object) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (width, height)).save(file, kind, **options)
    return file.getvalue()


def with_scans(count: int, before: bytes = b"") -> bytes:
    """A progressive JPEG of 10 scans and some more."""
    whole = saved(64, 48, "JPEG", progressive=True)
    last = whole.rfind(b"\xff\xda")
    return whole[:-2] + (before + whole[last:-2]) * count + whole[-2:]


@pytest.fixture(scope="module")
def small(folder, params):
    with serving(folder, params, max_pixels=9999) as running:
        yield running


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (saved(16383, 16383, "WEBP", lossless=True, method=0), "found 268402689 pixels, expected"),
        (saved(101, 99, "PNG"), None),
        (saved(101, 100, "PNG"), "found 10100 pixels, expected at most 9999 (--max-pixels"),
        (with_scans(300), "found a JPEG of 310 scans, expected at most 32"),
        # A marker that has no segment, and must not hide what is behind it.
        (with_scans(300, b"\xff\x01"), "found a JPEG of 310 scans, expected at most 32"),
        (with_scans(22), None),
        (with_scans(0) + 300 * b"\xff\xda", None),  # as a film behind a photograph may have
        (cv2.imencode(".ras", np.ones((9, 9, 3), np.uint8))[1].tobytes(), "that do not decode"),
        (cv2.imencode(".hdr", np.ones((9, 9, 3), np.float32))[1].tobytes(), "that do not decode"),
        *((saved(64, 48, kind), None) for kind in ("JPEG", "WEBP", "BMP", "TIFF", "GIF", "PPM")),
        *((saved(64, 48, kind), None) for kind in ("JPEG2000", "AVIF")),
    ],
)
def test_what_takes_long_is_not_decoded(small, data, words):
    reply = small.ask("POST", "/locate", data)
    assert reply.status == (200 if words is None else 400)
    assert words is None or words in reply.json["error"]


@pytest.mark.parametrize(
    "large", [saved(1700, 1300, "PNG"), *(saved(9, 9, kind) for kind in ("TIFF", "AVIF"))]
)
def test_large_pictures_hold_up_no_small_ones(folder, params, pictures, monkeypatch, large):
    """Nor do those whose head does not say how large their parts are."""
    go_on, decode = threading.Event(), app.decode_image

    def slow(data, name):
        assert data != large or go_on.wait(60)
        return decode(data, name)

    def slow_thumbnail(*_):
        assert go_on.wait(60)
        return b""

    monkeypatch.setattr(app, "decode_image", slow)
    monkeypatch.setattr(app, "read_thumbnail", slow_thumbnail)
    with serving(folder, params) as own, concurrent.futures.ThreadPoolExecutor(8) as pool:
        waiting = [pool.submit(own.ask, "POST", "/locate", large) for _ in range(4)]
        waiting += [pool.submit(own.ask, "GET", f"/images/{number}") for number in range(4)]
        assert own.ask("POST", "/locate", pictures[0].read_bytes()).status == 200
        assert not any(each.done() for each in waiting)
        go_on.set()
        assert [each.result().status for each in waiting] == [200] * 8
