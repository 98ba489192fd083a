"""Reading and listing images, against Pillow."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from crisalad_jax.data.images import IMAGE_SUFFIXES, list_images, read_image, read_pixels
from crisalad_jax.data.live import FolderWatch
from crisalad_jax.data.resize import resize_image
from crisalad_jax.data.sources import open_source
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests.conftest import PHOTOGRAPHS
from tests.data.benchmarks.trees import refused, touch_all

FORMATS = {
    "jpeg": ("JPEG", {}),
    "progressive": ("JPEG", {"progressive": True}),
    "restarts": ("JPEG", {"restart_marker_rows": 1}),
    "png": ("PNG", {}),
    "webp": ("WEBP", {}),
    "lossless.webp": ("WEBP", {"lossless": True}),
    "bmp": ("BMP", {}),
    "tif": ("TIFF", {"compression": "raw"}),
    "lzw.tif": ("TIFF", {"compression": "tiff_lzw"}),
    "gif": ("GIF", {}),
    "avif": ("AVIF", {}),
    "jp2": ("JPEG2000", {}),
    "ppm": ("PPM", {}),
}


def smooth_picture(height=60, width=80, channels=3, seed=0):
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (8, 10, channels), dtype=np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def encode(image, file_format, **options):
    buffer = io.BytesIO()
    image.save(buffer, file_format, **options)
    return buffer.getvalue()


def pillow_rgb(data):
    return np.asarray(ImageOps.exif_transpose(Image.open(io.BytesIO(data))).convert("RGB"))


def read_bytes(tmp_path, data, name="picture.jpg"):
    path = tmp_path / name
    path.write_bytes(data)
    return read_image(path)


def largest_difference(a, b):
    assert a.shape == b.shape
    return np.abs(a.astype(int) - b.astype(int)).max()


@pytest.mark.parametrize(
    "suffix",
    [
        *(".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".bmp", ".tif", ".tiff", ".gif"),
        *(".avif", ".jp2", ".ppm", ".pgm", ".pbm", ".pnm"),
    ],
)
def test_a_suffix_is_found_everywhere_and_read_as_by_pillow(tmp_path, suffix):
    """Pillow writes what it knows by the suffix; grey and bits where the suffix says so."""
    assert suffix in IMAGE_SUFFIXES
    watch = FolderWatch(tmp_path)
    picture = Image.fromarray(smooth_picture())
    picture = picture.convert({".pgm": "L", ".pbm": "1"}.get(suffix, "RGB"))
    for name in (f"a{suffix}", f"b{suffix.upper()}"):
        picture.save(tmp_path / name, Image.registered_extensions()[suffix])
    paths = [tmp_path / f"a{suffix}", tmp_path / f"b{suffix.upper()}"]
    assert list_images(tmp_path) == open_source(tmp_path / "*").paths == paths
    assert set(watch._scan()) == set(paths)
    for path in paths:
        # The same libraries' decoders: 2 leaves room for another inverse DCT (JPEG, WebP, AVIF).
        assert largest_difference(read_image(path), pillow_rgb(path.read_bytes())) <= 2


@pytest.mark.parametrize(
    ("mode", "size", "file_format", "most"),
    [
        *((mode, (60, 80), "PNG", 0) for mode in ("1", "L", "LA", "P", "RGBA")),
        *(("RGB", size, "PNG", 0) for size in ((1, 1), (8, 20_000))),
        # OpenCV 5.0 gives blue first where an AVIF has alpha. Most as for a whole file below.
        ("RGBA", (60, 80), "AVIF", 2),
    ],
)
def test_modes_and_sizes(tmp_path, mode, size, file_format, most):
    picture = Image.fromarray(smooth_picture(*size)).convert(mode)
    if mode in ("LA", "RGBA"):
        # Transparency from 0 to 255: what it hides must show, as Pillow's convert shows it.
        alpha = np.tile(np.linspace(0, 255, 80).astype(np.uint8), (60, 1))
        picture.putalpha(Image.fromarray(alpha))
    data = encode(picture, file_format)
    found = read_bytes(tmp_path, data, "Zürich 東京.jpg")
    assert largest_difference(found, pillow_rgb(data)) <= most


@pytest.mark.parametrize("suffix", [".png", ".tif", ".ppm"])
def test_sixteen_bits_stay_for_the_model_to_reduce(tmp_path, suffix):
    """OpenCV 5.0 confuses the channels of a TIFF that it is asked for as RGB."""
    rgb = (7 + 3000 * np.arange(18, dtype=np.uint16)).reshape(2, 3, 3)
    cv2.imwrite(str(tmp_path / f"a{suffix}"), rgb[..., ::-1])
    np.testing.assert_array_equal(read_pixels(tmp_path / f"a{suffix}"), rgb)
    np.testing.assert_array_equal(read_image(tmp_path / f"a{suffix}"), rgb >> 8)


@pytest.mark.parametrize("white", [1, 15, 100, 254, 255, 1023, 4095, 65534, 65535])
@pytest.mark.parametrize("kind", ["P2", "P3", "P5", "P6"])
def test_white_of_a_pnm_is_what_its_header_says(tmp_path, kind, white):
    """Pillow is another reader; the specification says that values are shares of the largest."""
    channels = 3 if kind in ("P3", "P6") else 1
    values = np.linspace(0, white, 48 * channels).round().astype(int).reshape(6, 8, channels)
    head = f"{kind}\n# 1 2 3\n8 6 # a camera's\n{white}\n".encode()
    if kind in ("P2", "P3"):
        data = head + " ".join(map(str, values.ravel())).encode() + b"\n"
    else:
        data = head + values.astype(">u2" if white > 255 else np.uint8).tobytes()
    (tmp_path / "a.pnm").write_bytes(data)
    found = read_pixels(tmp_path / "a.pnm")
    assert found.dtype == (np.uint16 if white > 255 else np.uint8)
    shares = values / white * np.iinfo(found.dtype).max
    # The nearest whole number; of texts OpenCV drops what is behind the point.
    is_cut = white < 256 and kind in ("P2", "P3")
    np.testing.assert_array_less(np.abs(found - shares), 1 if is_cut else 0.5 + 1e-9)
    if white < 256 and not is_cut:
        np.testing.assert_array_equal(read_image(tmp_path / "a.pnm"), pillow_rgb(data))


@pytest.mark.parametrize(
    ("dtype", "unit"), [(np.float32, 0.01), (np.float64, 0.01), (np.int32, 1), (np.int16, -1)]
)
def test_a_tiff_of_floats_is_stretched_on_request(tmp_path, dtype, unit):
    """Of 101 values the 1st and the 99th percentile are the second and the last but one."""
    values = (np.arange(101).reshape(1, 101) + 7200) * unit
    data = cv2.imencode(".tif", values.astype(dtype))[1].tobytes()
    (tmp_path / "t.tif").write_bytes(data)
    with refused(rf"t\.tif: found {np.dtype(dtype)} of shape .*contrast-stretch"):
        read_image(tmp_path / "t.tif")
    grey = np.clip(255 * (np.arange(101) - 1) / 98, 0, 255)[:: int(np.sign(unit))]
    found = read_image(tmp_path / "t.tif", bit_depth="contrast-stretch")
    # A half more or less where rounding of the values decides.
    np.testing.assert_allclose(found[0], np.stack([grey] * 3, -1), atol=0.51)
    assert (found.min(), found.max()) == (0, 255)


@pytest.mark.parametrize("adobe", [True, False])
def test_cmyk_jpeg(tmp_path, adobe):
    cmyk = Image.frombytes("CMYK", (80, 60), smooth_picture(channels=4).tobytes())
    data = encode(cmyk, "JPEG", quality=95)
    start = data.index(b"\xff\xee")
    if not adobe:
        data = data[:start] + data[start + 2 + int.from_bytes(data[start + 2 : start + 4], "big") :]
    # OpenCV divides by 256 where Pillow divides by 255, twice: a level each.
    assert largest_difference(read_bytes(tmp_path, data), pillow_rgb(data)) <= 2


@pytest.mark.parametrize(
    ("enough", "factor"),
    [((51, 51), 1), ((50, 50), 2), ((20, 50), 2), ((25, 25), 4), ((12, 12), 8), ((1, 1), 8)],
)
@pytest.mark.parametrize("turned", [False, True], ids=("upright", "turned"))
def test_a_large_jpeg_is_decoded_at_less_than_its_size(tmp_path, enough, factor, turned):
    """Of 200 x 240 twice what is enough is left at least; Pillow's draft mode does the same."""
    exif = Image.Exif()
    exif[0x0112] = 6 if turned else 1
    data = encode(Image.fromarray(smooth_picture(200, 240)), "JPEG", quality=95, exif=exif)
    path = tmp_path / "picture.jpg"
    path.write_bytes(data)
    image = Image.open(io.BytesIO(data))
    image.draft("RGB", (240 // factor, 200 // factor))
    expected = np.asarray(ImageOps.exif_transpose(image))
    found = read_image(path, enough=enough)
    assert min(found.shape[:2]) == 200 // factor
    # Two versions of one decoder, as above.
    assert largest_difference(found, expected) <= 2
    whole, resized = (resize_image(one, enough).astype(float) for one in (read_image(path), found))
    # Levels of 256, as `read_image` says; the worst of these cases is at 1.2, an eighth.
    assert np.sqrt(np.mean((whole - resized) ** 2)) < 2


def test_only_a_jpeg_is_decoded_at_less_than_its_size(tmp_path):
    path = tmp_path / "picture.png"
    path.write_bytes(encode(Image.fromarray(smooth_picture(200, 240)), "PNG"))
    np.testing.assert_array_equal(read_image(path, enough=(10, 10)), read_image(path))


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("file_format", ["JPEG", "PNG", "TIFF", "WEBP", "AVIF"])
def test_exif_orientation(tmp_path, file_format, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    data = encode(Image.fromarray(smooth_picture()), file_format, exif=exif)
    # As above; a wrong orientation differs by tens of levels.
    assert largest_difference(read_bytes(tmp_path, data), pillow_rgb(data)) <= 2


@pytest.mark.parametrize("name", FORMATS)
def test_a_whole_file_is_read_as_by_pillow_and_a_cut_one_is_an_error(tmp_path, capfd, name):
    file_format, options = FORMATS[name]
    data = encode(Image.fromarray(smooth_picture(240, 320)), file_format, **options)
    # Both decode with the same libraries; 2 leaves room for another inverse DCT.
    assert largest_difference(read_bytes(tmp_path, data), pillow_rgb(data)) <= 2
    for share in (0.01, 0.3, 0.6, 0.9, 0.9999):
        with pytest.raises(InputError, match=r"picture\.jpg: found"):
            read_bytes(tmp_path, data[: int(len(data) * share)])
    assert capfd.readouterr() == ("", "")


def test_a_cut_jpeg_with_a_whole_thumbnail_is_an_error(tmp_path):
    picture = Image.fromarray(smooth_picture(240, 320))
    thumbnail = encode(picture.resize((40, 30)), "JPEG")
    data = encode(picture, "JPEG", exif=b"Exif\0\0" + thumbnail)
    assert data.index(b"\xff\xd9") < len(data) // 2
    assert read_bytes(tmp_path, data).shape == (240, 320, 3)
    with pytest.raises(InputError, match="cut short"):
        read_bytes(tmp_path, data[: len(data) // 2])


@pytest.mark.parametrize("file_format", ["JPEG", "PNG"])
def test_bytes_after_the_end_do_not_matter(tmp_path, file_format):
    data = encode(Image.fromarray(smooth_picture()), file_format)
    expected = read_bytes(tmp_path, data)
    np.testing.assert_array_equal(read_bytes(tmp_path, data + b"\0" * 3 + data[:99]), expected)


@pytest.mark.parametrize("name", ["jpeg", "progressive", "restarts", "png"])
def test_a_missing_byte_and_a_half_of_zeros_are_cuts(tmp_path, name):
    file_format, options = FORMATS[name]
    data = encode(Image.fromarray(smooth_picture(240, 320)), file_format, **options)
    for cut in (data[:-1], data[: len(data) // 2] + bytes(len(data) // 2)):
        with refused("cut short"):
            read_bytes(tmp_path, cut)


def png_of_claimed_size(width, height):
    def chunk(kind, content):
        checksum = struct.pack(">I", zlib.crc32(kind + content))
        return struct.pack(">I", len(content)) + kind + content + checksum

    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    content = (
        chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(99))) + chunk(b"IEND", b"")
    )
    return b"\x89PNG\r\n\x1a\n" + content


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "an empty file"),
        (b"\xff", "1 bytes that do not decode"),
        (b"this is text\n" * 50, "650 bytes that do not decode"),
        (png_of_claimed_size(60_000, 60_000), r"more than \d+ pixels"),
        # A side of which libpng would warn.
        (png_of_claimed_size(2**31 - 1, 2), "an image cut short after .*, or damaged"),
    ],
    ids=["empty", "one byte", "text", "bomb", "side"],
)
def test_no_image(tmp_path, data, words, capfd):
    with refused(rf"picture\.jpg: found {words}"):
        read_bytes(tmp_path, data)
    assert capfd.readouterr().err == ""


def test_no_file(tmp_path):
    with pytest.raises(InputError, match=r"nothing\.jpg: found no such file, expected an image"):
        read_image(tmp_path / "nothing.jpg")
    with pytest.raises(InputError, match=f"{tmp_path.name}: found a folder, expected an image"):
        read_image(tmp_path)


def test_list_images(tmp_path):
    names = ["b/2.JPG", "b/10.jpeg", "a.png", "b.tif", "b/c/x.WebP", "b-1.bmp", "é.TIFF"]
    touch_all(tmp_path, [*names, ".hidden.jpg", "b/.cache/y.jpg", "b/._2.JPG"])
    found = list_images(str(tmp_path))
    assert [path.relative_to(tmp_path).as_posix() for path in found] == sorted(names)


def test_what_is_no_image_is_counted_in_one_note(tmp_path):
    """Not counted: hidden files, tables, and what is named as an image (sidecars)."""
    names = ["1.jpg", "4.raw.jpg", "sub/2.png"]
    counted = ["3.heic", "a.txt", "sub/b.TXT", "walk.mp4", "c.npy", "d.json", "e.xml", "f.dng"]
    counted += ["jpg", "z.jpg.part"]
    quiet = [".DS_Store", "positions.csv", "1.json", "sub/2.png.xmp", "4.raw"]
    touch_all(tmp_path, [*names, *counted, *quiet, "1.heic"])
    with pytest.warns(Note) as notes:
        assert list_images(tmp_path) == [tmp_path / name for name in names]
    (line,) = (str(note.message) for note in notes)
    rest = "1 .dng, 1 .heic, 1 .json, 1 .mp4, 1 .npy, 1 .part, 1 .xml, 1 without a suffix"
    assert line == f"{tmp_path}: skipped 10 other files: 2 .txt, {rest}"
    rest = "1 .dng, 1 .heic, 1 .json, 1 .npy, 1 .txt, 1 .xml$"
    with pytest.warns(Note, match=rf"\*: skipped 6 other files: {rest}"):
        source = open_source(tmp_path / "[13acdef]*")
    assert source.names == ["1.jpg"]


def test_list_images_follows_links_but_not_in_circles(tmp_path):
    touch_all(tmp_path / "elsewhere", ["a.jpg"])
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "database").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "set" / "again").symlink_to(tmp_path / "set")
    assert list_images(tmp_path / "set") == [tmp_path / "set" / "database" / "a.jpg"]


def test_list_images_of_nothing(tmp_path):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(InputError, match=r"found no image among 1 \.txt, expected"):
        list_images(tmp_path)
    with pytest.raises(InputError, match=r"notes\.txt: found a file, expected a folder"):
        list_images(tmp_path / "notes.txt")


def test_photographs_read_and_resize_as_by_pillow():
    if not PHOTOGRAPHS.is_dir():
        pytest.skip("no photographs beside the checkout")
    for path in list_images(PHOTOGRAPHS / "toy_streets")[::8]:
        expected = Image.open(path).convert("RGB").resize((224, 224), Image.Resampling.BILINEAR)
        resized = resize_image(read_image(path), (224, 224))
        # One level from the resize, two from the JPEG decoder, as above.
        assert largest_difference(resized, np.asarray(expected)) <= 3
