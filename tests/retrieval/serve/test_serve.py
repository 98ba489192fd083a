"""The service over HTTP, beside `crisalad query`'s answers."""

import base64
import concurrent.futures
import dataclasses
import hashlib
import importlib.resources
import itertools
import json
import logging
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.request

import cv2
import numpy as np
import pytest

from crisalad_jax.checkpoints.load import load
from crisalad_jax.data.images import IMAGE_SUFFIXES, list_images, read_image
from crisalad_jax.data.positions import Positions
from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.build import index
from crisalad_jax.retrieval.maps.calibration import Calibration, write_calibration
from crisalad_jax.retrieval.maps.corrections import remove_images
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.metadata import SEGMENTS
from crisalad_jax.retrieval.maps.query import answer_fields, query
from crisalad_jax.retrieval.serve.worker import ADDED
from crisalad_jax.retrieval.verification.verify import Verify
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests.conftest import BATCH, MODEL, read_options, write_video
from tests.data.test_sources import write_jpeg
from tests.retrieval.serve.conftest import LIMIT, TOGETHER, serving

# Batches of other sizes round otherwise; similarities are printed with six digits.
ROUNDING = 5e-6
CLIENTS, EACH = 32, 3


@pytest.fixture(scope="module")
def expected(folder, params, pictures):
    """What `crisalad query --json` prints of each picture, by its name."""
    with Map.open(folder) as places:
        answers = query(
            places,
            pictures,
            model=Model(params, places.config),
            k=3,
            reading=Reading(batch_size=BATCH, quiet=True),
        )
    rows = [(path.name, [answer_fields(a, answers.axes) for a in r]) for path, r in answers.rows()]
    return dict(rows)


def assert_answers(found, expected):
    assert [set(one) - {"number", "verified"} for one in found] == [
        set(other) for other in expected
    ]
    for one, other in zip(found, expected, strict=True):
        assert one["similarity"] == pytest.approx(other["similarity"], abs=ROUNDING)
        for field in ("rank", "name", "position"):
            assert one[field] == other[field]


def form(data: bytes, field: str = "image") -> tuple[bytes, dict[str, str]]:
    head = f'--b\r\nContent-Disposition: form-data; name="{field}"; filename="a b.jpg"\r\n\r\n'
    return head.encode() + data + b"\r\n--b--\r\n", {
        "Content_Type": "multipart/form-data; boundary=b"
    }


def test_many_clients_get_the_answers_of_query(service, pictures, expected, monkeypatch):
    search, threads = Map.search, set()

    def recorded(*arguments, **options):
        threads.add(threading.get_ident())
        return search(*arguments, **options)

    monkeypatch.setattr(Map, "search", recorded)

    def client(number):
        mine = [pictures[(number + i) % len(pictures)] for i in range(EACH)]
        return [(path.name, service.ask("POST", "/locate?k=3", path.read_bytes())) for path in mine]

    with concurrent.futures.ThreadPoolExecutor(CLIENTS) as pool:
        replies = [each for got in pool.map(client, range(CLIENTS)) for each in got]
    assert len(replies) == CLIENTS * EACH
    for name, reply in replies:
        assert reply.status == 200
        assert_answers(reply.json["neighbours"], expected[name])
        assert reply.json["latency_ms"] > 0
    assert len(threads) == 1  # which owns the map


def test_a_map_of_the_model_in_the_package_is_served_by_it(sides, pictures, tmp_path):
    own, config = load("starter")
    index(
        Model(own, config),
        sides[0],
        tmp_path / "map",
        weights="starter",
        reading=Reading(quiet=True),
    )
    with Map.open(tmp_path / "map") as places:
        params = places.load_model().params
        answers = query(places, sides[1], k=1, reading=Reading(quiet=True))
    with serving(tmp_path / "map", params) as service:
        for path, ranked in answers.rows():
            reply = service.ask("POST", "/locate?k=1", path.read_bytes())
            assert_answers(
                reply.json["neighbours"], [answer_fields(one, answers.axes) for one in ranked]
            )


def test_answers_are_verified(own_map, params, pictures):
    with Map.open(own_map) as places:
        model = Model(params, places.config)
        quiet = Reading(batch_size=BATCH, quiet=True)
        given = {"model": model, "k": 4, "reading": quiet, "verify": Verify(answers=3)}
        found = query(places, pictures[0], **given)
        known = Calibration(-1.0, 0.9, 1, 1, 1, 0, 0, 7, "", "", places.metadata.model)
    inliers = [check.inliers for check in found.checks[0]]
    ask = "POST", "/locate?k=4", pictures[0].read_bytes()
    write_calibration(
        own_map, dataclasses.replace(known, min_inliers=inliers[0] + 1, verifier="sift")
    )
    with serving(own_map, params, rerank=Verify(answers=3)) as service:
        reply = service.ask(*ask).json
        verified = [each["verified"] for each in reply["neighbours"]]
        assert [each and each["inliers"] for each in verified] == [*inliers, None]
        names = [found.images[i].name for i in found.neighbours.indices[0]]
        assert [each["name"] for each in reply["neighbours"]] == names
        assert reply["known"] is False
        less = service.ask("POST", "/locate?k=4&verify=1", ask[2]).json
        assert [bool(each["verified"]) for each in less["neighbours"]] == [True, *3 * [False]]
        none = service.ask("POST", "/locate?k=4&verify=0", ask[2]).json
        assert not any(each["verified"] for each in none["neighbours"])
        assert none["known"] is None  # of similarities nothing was measured
        assert service.ask("POST", "/locate?verify=-1", ask[2]).status == 400
    with serving(own_map, params) as service:
        reply = service.ask("POST", "/locate?verify=1", ask[2])
        assert reply.json == {"error": "verify: found in a service without --rerank, expected none"}
        assert service.ask(*ask).json["neighbours"][0]["verified"] is None


def test_files_that_are_gone_are_the_service_s_fault(own_map, params, pictures, tmp_path):
    """A client does not learn the names of folders."""
    with serving(own_map, params, rerank=Verify(answers=1)) as service:
        parts = service.worker.places.images.parts
        parts[:] = [part._replace(root=str(tmp_path)) for part in parts]
        reply = service.ask("POST", "/locate", pictures[0].read_bytes())
        assert reply.status == 500
        assert str(tmp_path) not in reply.json["error"]


def test_a_calibrated_map_knows_what_it_does_not_know(own_map, params, pictures, expected):
    best = {name: ranked[0]["similarity"] for name, ranked in expected.items()}
    ordered = sorted(best.values())
    # In the widest gap between two pictures: rounding does not decide.
    low, high = max(itertools.pairwise(ordered), key=lambda pair: pair[1] - pair[0])
    with Map.open(own_map) as places:
        model = places.metadata.model
    write_calibration(own_map, Calibration((low + high) / 2, 0.9, 1, 1, 1, 0, 0, 7, "", "", model))
    with serving(own_map, params) as service:
        for path in pictures:
            reply = service.ask("POST", "/locate", path.read_bytes())
            assert reply.json["known"] == (best[path.name] >= high)


def test_a_form_is_as_good_as_a_body(service, pictures, expected):
    data, headers = form(pictures[0].read_bytes())
    reply = service.ask("POST", "/locate?k=3", data, **headers)
    assert_answers(reply.json["neighbours"], expected[pictures[0].name])
    # The number of answers is the service's where the request names none, at most the map's size.
    assert len(service.ask("POST", "/locate", data, **headers).json["neighbours"]) == 5
    assert len(service.ask("POST", "/locate?k=99", data, **headers).json["neighbours"]) == 7


def test_a_request_may_be_of_some_images(service, pictures):
    """Two at once with other conditions: each has the whole map's answers, without others."""
    data = pictures[0].read_bytes()
    whole = service.ask("POST", "/locate?k=99", data).json["neighbours"]
    east = {each["number"]: each["position"]["east"] for each in whole if each["position"]}
    ends = (max(east.values()), min(east.values()))

    def ask(west):
        path = f"/locate?k=99&where=box={west},-9e9,9e9,9e9"
        return [each["number"] for each in service.ask("POST", path, data).json["neighbours"]]

    with concurrent.futures.ThreadPoolExecutor(2) as threads:
        for west, found in zip(ends, threads.map(ask, ends), strict=True):
            assert found == [number for number, at in east.items() if at >= west]
            assert found
    reply = service.ask("POST", "/locate?where=folder=nowhere", data)
    assert reply.status == 400
    assert reply.json["error"].startswith("where: found none of 7 images (0 by folder)")


@pytest.mark.parametrize(
    ("method", "path", "body", "status", "words"),
    [
        ("POST", "/locate?where=colour", b"", 400, "where: found 'colour', expected folder="),
        ("POST", "/locate", b"", 400, "image: found an empty file, expected an image (.jpg"),
        ("POST", "/locate", b"hello", 400, "image: found 5 bytes that do not decode"),
        ("POST", "/locate", b"\xff\xd8\xff\xe0 cut", 400, "image: found 8 bytes that do"),
        ("POST", "/locate?k=0", b"", 400, "k: found '0'"),
        ("POST", "/locate?k=101", b"", 400, "k: found '101'"),
        ("POST", "/locate?k=x", b"", 400, "k: found 'x'"),
        ("POST", "/locate", bytes(LIMIT + 1), 413, f"found more than {LIMIT} bytes"),
        ("POST", "/locate", iter([bytes(LIMIT)] * 2), 413, f"found more than {LIMIT} bytes"),
        ("POST", "/images?name=a.jpg", b"", 403, "a read-only map"),
        ("GET", "/locate", None, 405, "method not allowed"),
        ("GET", "/images/7", None, 404, "number: found 7, expected 0 to 6"),
        ("GET", "/images/-1", None, 404, "number: found -1"),
        ("GET", "/images/..%2f..%2fmap.json", None, 404, "not found"),
        ("GET", "/docs", None, 404, "not found"),
        ("GET", "/map/", None, 404, "not found"),
        ("POST", "/locate?k=1&k=2", b"", 400, "k: found it 2 times, expected it once"),
        # Of every route; a wrong name is told before the picture is looked at.
        ("POST", "/locate?top=3", b"hello", 400, "top: found '3', extra inputs are not permitted"),
        ("POST", "/locate?k=3&K=4", b"", 400, "K: found '4', extra inputs are not permitted"),
        ("POST", "/images?name=a.jpg&latitude=1", b"", 400, "latitude: found '1', extra inputs"),
        ("GET", "/?k=3", None, 400, "k: found '3', extra inputs are not permitted"),
        ("GET", "/health?x", None, 400, "x: found '', extra inputs are not permitted"),
        ("GET", "/map?x=", None, 400, "x: found '', extra inputs are not permitted"),
        ("GET", "/images/2?size=9", None, 400, "size: found '9', extra inputs are not permitted"),
    ],
)
def test_what_is_not_answered_is_told_in_one_line(service, method, path, body, status, words):
    reply = service.ask(method, path, body)
    assert reply.status == status
    assert reply.headers["content-type"] == "application/json"
    assert set(reply.json) == {"error"}
    assert words.lower() in reply.json["error"].lower()
    assert reply.headers["x-content-type-options"] == "nosniff"


def test_a_form_without_a_picture(service, pictures):
    data, headers = form(pictures[0].read_bytes(), field="other")
    reply = service.ask("POST", "/locate", data, **headers)
    expected = "image: found a form of other, expected one file of this name"
    assert (reply.status, reply.json["error"]) == (400, expected)
    # As of `curl -F k=3 -F image=@a.jpg`.
    data = b'--b\r\nContent-Disposition: form-data; name="k"\r\n\r\n3\r\n' + form(b"x")[0]
    reply = service.ask("POST", "/locate", data, **headers)
    expected = "image: found a form of k, image, expected one file of this name"
    assert (reply.status, reply.json["error"]) == (400, expected)
    empty = b'--b\r\nContent-Disposition: form-data; name="image"\r\n\r\nx\r\n--b--\r\n'
    reply = service.ask("POST", "/locate", empty, **headers)
    assert (reply.status, reply.json["error"][:5]) == (400, "image")
    data, headers = form(b"hello")
    reply = service.ask("POST", "/locate", data, **headers)
    assert reply.status == 400
    assert reply.json["error"].startswith("a b.jpg: found 5 bytes")


def test_a_form_with_two_files_or_too_many_fields(service, pictures):
    data, headers = form(pictures[0].read_bytes())
    first = data.removesuffix(b"--b--\r\n")
    field = b'--b\r\nContent-Disposition: form-data; name="k"\r\n\r\n3\r\n'
    reply = service.ask("POST", "/locate", first + data, **headers)
    assert (reply.status, reply.json["error"]) == (
        400,
        "image: found a form of image, image, expected one file of this name",
    )
    for body, words in (
        (first * 11 + b"--b--\r\n", "Too many files. Maximum number of files is 10."),
        (field * 11 + b"--b--\r\n", "Too many fields. Maximum number of fields is 10."),
        (b"--b\r\nno form", "Invalid multipart data."),
    ):
        reply = service.ask("POST", "/locate", body, **headers)
        assert (reply.status, reply.json) == (400, {"error": words})
    named = {"Content_Type": f"{headers['Content_Type']}; charset=undefined"}  # no text is of it
    reply = service.ask("POST", "/locate", data, **named)
    assert reply.status == 400
    assert reply.json["error"].startswith("image: found a form of another charset: ")
    assert not logging.getLogger("python_multipart.multipart").isEnabledFor(logging.WARNING)


def test_the_interface_lists_what_is_answered(service):
    interface = service.ask("GET", "/openapi.json").json
    answered = {
        (method, path): set(operation["responses"])
        for path, operations in interface["paths"].items()
        for method, operation in operations.items()
    }
    assert answered == {
        ("get", "/health"): {"200", "default"},
        ("get", "/map"): {"200", "default"},
        ("get", "/images/{number}"): {"200", "default"},
        ("post", "/locate"): {"200", "default"},
        ("post", "/images"): {"201", "default"},
    }
    assert service.ask("GET", "/images/x").status == 400
    assert service.ask("POST", "/images").status == 400  # no name
    assert service.ask("GET", "/health", Host="robot.example").status == 400
    assert not re.search("ValidationError", json.dumps(interface))


@pytest.mark.parametrize(("axes", "there"), [(("lat", "lon"), None), (("east", "north"), (1, 2))])
def test_a_picture_is_added_where_its_exif_data_says(shared, params, tmp_path, axes, there):
    """In a map without positions, or in degrees; one in metres leaves it out, as `index` does."""
    (tmp_path / "images").mkdir()
    picture = write_jpeg(tmp_path / "images" / "a.jpg")
    bare = tmp_path / "images" / "b.png"
    cv2.imwrite(str(bare), np.full((50, 70, 3), 90, np.uint8))
    of = Positions(axes, {} if there is None else {"b.png": there})
    out, weights = tmp_path / "map", shared / "weights.safetensors"
    more = {"weights": weights} | read_options({})
    index(Model(params, MODEL), bare, out, positions=None if there is None else of, **more)
    data = picture.read_bytes()
    with serving(out, params, appends=True) as own:
        added = own.ask("POST", "/images?name=new.jpg", data).json
        # 1e-6: EXIF has ratios of integers of 32 bits.
        exif = {"lat": pytest.approx(52.2296, abs=1e-6), "lon": pytest.approx(21.0125, abs=1e-6)}
        assert added["position"] == (exif if there is None else None)
        # What the request says stands before it.
        said = dict(zip(axes, (3.0, 4.0), strict=True))
        path = "/images?name=said.jpg" + "".join(f"&{key}={value}" for key, value in said.items())
        assert own.ask("POST", path, data).json["position"] == said


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
@pytest.mark.parametrize(("width", "height"), [(600, 350), (60, 350), (600, 60), (64, 76)])
def test_the_map_is_drawn_in_any_window(width, height):
    page = (
        importlib.resources.files("crisalad_jax.retrieval.serve").joinpath("page.html").read_text()
    )
    functions = re.findall(r"^function (?:plane|drawMap)\(.*?^}$", page, re.DOTALL | re.MULTILINE)
    assert len(functions) == 2
    program = f"""
        const state = {{ map: {{ positions: [[0, 1, 2], [1, 90, 40]], axes: ["east", "north"],
                                 positions_known: 2 }}, answers: [], near: false }};
        const shown = [];
        const svg = {{ clientWidth: {width}, clientHeight: {height}, replaceChildren() {{}},
                       setAttribute(_, value) {{ shown.push(value); }}, append() {{}},
                       classList: {{ toggle() {{}} }} }};
        const at = (id) => id === "svg" ? svg : {{}};
        const draw = (_, attributes, text) => shown.push(...Object.values(attributes), text);
        {"".join(functions)}
        drawMap();
        console.log(shown.join("|"));
    """
    done = subprocess.run(["node", "-e", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "M14 " in done.stdout
    assert not re.search("NaN|Infinity|undefined m", done.stdout)


def test_other_sites_are_refused(service, pictures):
    data = pictures[0].read_bytes()
    own = f"http://127.0.0.1:{service.port}"
    assert service.ask("POST", "/locate", data, Origin=own).status == 200
    assert service.ask("POST", "/locate", data, Origin="https://evil.example").status == 403
    for origin in ("null", own.replace("http", "https"), "http://127.0.0.1:9"):
        assert service.ask("POST", "/locate", data, Origin=origin).status == 403
    for path in ("/", "/map", "/no-route"):
        for host in (
            *("evil.example", "127.0.0.1.evil.example", "", "[", "a@[::1", "127.0.0.1:x"),
            *("evil.example@127.0.0.1", "[::1].evil.example", "127a0a0a1", "localhost:80@a"),
        ):
            reply = service.ask("GET", path, Host=host)
            words = f"Host: found {host!r}, expected this machine's, or a token"
            assert (reply.status, reply.json) == (400, {"error": words})
    for host in ("localhost:8000", "127.0.0.1", "[::1]:8000", "LOCALHOST"):
        assert service.ask("GET", "/map", Host=host).status == 200
        own = {"Host": host, "Origin": f"http://{host}"}
        assert service.ask("POST", "/locate", data, **own).status == 200


def test_health_and_interface(service, folder):
    health = service.ask("GET", "/health").json
    with Map.open(folder) as places:
        assert (health["status"], health["images"], health["model"]) == (
            "ok",
            7,
            places.metadata.model,
        )
        described = service.ask("GET", "/map").json
        assert (described["axes"], described["zone"]) == (["east", "north"], "10 south")
        assert described["positions"] == [
            [number, *image.position] for number, image in enumerate(places.images)
        ]
    assert (health["search"], health["stale_search"]) == ("exact", None)
    assert health["uptime_s"] >= 0
    interface = service.ask("GET", "/openapi.json").json
    assert set(interface["paths"]) == {"/health", "/map", "/locate", "/images", "/images/{number}"}
    assert "image/*" in interface["paths"]["/locate"]["post"]["requestBody"]["content"]


@pytest.mark.parametrize(
    "path", ["/", "/health", "/map", "/images/2", "/openapi.json", "/images/99", "/locate"]
)
def test_head_is_get_without_a_body(service, path):
    """As RFC 9110 has it, also of an error; /locate is for POST alone."""
    asked, head = service.ask("GET", path), service.ask("HEAD", path)
    assert head.status == asked.status == {"/images/99": 404, "/locate": 405}.get(path, 200)
    assert head.data == b""
    differing = {"date", "content-length"} if path == "/health" else {"date"}  # an uptime grows
    assert {k: v for k, v in head.headers.items() if k not in differing} == {
        k: v for k, v in asked.headers.items() if k not in differing
    }


@pytest.mark.parametrize("appends", [False, True])
def test_a_stale_search_is_told_at_the_start_and_by_health(own_map, params, pictures, appends):
    with Map.open(own_map) as places, open_for_appending(own_map, places.metadata) as target:
        target.build_search("hnsw")
        first = target.descriptors
        row = next(iter(first))[:1]
        target.append(["new.jpg"], [7], row, root="/images")
    said = pytest.warns(Note, match=r"own\.map: found an approximate search of fewer .* hnsw")
    with said, serving(own_map, params, appends=appends) as own:
        health = own.ask("GET", "/health").json
        assert (health["search"], health["stale_search"]) == ("exact", "hnsw")


def test_the_page_holds_all_it_shows(service):
    reply = service.ask("GET", "/")
    page = reply.data.decode()
    file = importlib.resources.files("crisalad_jax.retrieval.serve").joinpath("page.html")
    suffixes = ",".join(IMAGE_SUFFIXES)
    assert page == file.read_text().replace("IMAGE_SUFFIXES", suffixes)
    assert f'accept="{suffixes}"' in page
    assert not re.findall(r"""(?:src|href)=["']?(?!data:)\w""", page)
    policy = reply.headers["content-security-policy"]
    for tag in ("script", "style"):
        (text,) = re.findall(rf"<{tag}>(.*)</{tag}>", page, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy
    assert "frame-ancestors 'none'" in policy
    # Names are text: nothing is parsed as HTML.
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write", page)


def test_pictures_of_the_map(service, sides, own_map, params):
    reply = service.ask("GET", "/images/2")
    assert reply.headers["content-type"] == "image/jpeg"
    shown = cv2.imdecode(np.frombuffer(reply.data, np.uint8), cv2.IMREAD_COLOR_RGB)
    original = read_image(sorted(sides[0].iterdir())[2])
    assert shown.shape == original.shape  # 70 x 50 pixels are small enough
    # A JPEG of a JPEG with noise: a few levels of 256 on average.
    assert np.abs(shown.astype(int) - original).mean() < 12
    # In another folder, whose picture 3 is another one, and 4 is gone.
    moved = own_map.parent / "moved"
    moved.mkdir()
    for number, path in enumerate(sorted(sides[0].iterdir())):
        data = path.read_bytes()
        (moved / path.name).write_bytes(data + b"more" if number == 3 else data)
    with serving(own_map, params, map_images=moved) as own:
        assert own.ask("GET", "/images/2").status == 200
        parts = own.worker.places.images.parts
        parts[:] = [part._replace(root="/nowhere") for part in parts]
        assert own.ask("GET", "/images/3").status == 404
        assert own.ask("GET", "/images/4").status == 200


def test_a_correction_is_seen_and_other_numbers_stay(own_map, params, sides):
    first, _, last, *_ = list_images(sides[0])
    with serving(own_map, params) as own:

        def best(path):
            return own.ask("POST", "/locate?k=1", path.read_bytes()).json["neighbours"][0]

        before = best(first), best(last)
        assert [each["name"] for each in before] == [first.name, last.name]
        picture = own.ask("GET", f"/images/{before[1]['number']}")
        remove_images(own_map, [first.name])
        assert best(first)["name"] != first.name
        assert best(last)["number"] == before[1]["number"]
        assert own.ask("GET", f"/images/{before[1]['number']}").data == picture.data
        gone = own.ask("GET", f"/images/{before[0]['number']}")
        assert (gone.status, "was removed from the map" in gone.json["error"]) == (404, True)
        assert own.ask("GET", "/health").json["images"] == 6
        numbers = [number for number, *_ in own.ask("GET", "/map").json["positions"]]
        assert numbers == [n for n in range(7) if n != before[0]["number"]]
        for bad in (-1, 7):
            assert own.ask("GET", f"/images/{bad}").status == 404
        # What fails is told, and tried again.
        change = own_map / "segments" / "change-0000000001.json"
        change.write_text("{}")
        assert own.ask("POST", "/locate", last.read_bytes()).status == 500
        change.unlink()
        assert best(last)["name"] == last.name


def test_a_frame_of_a_video_is_shown_under_its_name(shared, params, tmp_path):
    video = write_video(tmp_path / "walk.avi", 13)
    weights = shared / "weights.safetensors"
    out = tmp_path / "walk.map"
    index(
        Model(params, MODEL),
        f"{video}#t=1.2",
        out,
        weights=weights,
        reading=Reading(batch_size=BATCH, quiet=True),
    )
    with serving(out, params) as own:
        (found,) = own.ask(
            "POST", "/locate", cv2.imencode(".png", np.zeros((48, 64, 3), np.uint8))[1].tobytes()
        ).json["neighbours"]
        assert found["name"] == "walk.avi#t=1.200"
        reply = own.ask("GET", f"/images/{found['number']}")
    assert reply.headers["content-type"] == "image/jpeg"
    shown = cv2.imdecode(np.frombuffer(reply.data, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert abs(shown.mean() - 120) < 4  # frame 12 is flat of level 120; two JPEGs move it little


def test_a_thermal_picture_is_shown_with_contrast(shared, params, tmp_path):
    """Of 16 bits, from 7,200 to 8,900, which by their high bytes are 7 levels."""
    thermal, weights = tmp_path / "thermal.png", shared / "weights.safetensors"
    cv2.imwrite(str(thermal), np.tile(np.linspace(7200, 8900, 70).astype(np.uint16), (50, 1)))
    out = tmp_path / "map"
    index(
        Model(params, MODEL),
        thermal,
        out,
        weights=weights,
        reading=Reading(batch_size=BATCH, quiet=True),
    )
    with serving(out, params, appends=True) as own:
        data = own.ask("GET", "/images/0").data
        # The first position of a map says of which zone all are.
        path = "/images?name=@0500000.00@5411000.00@32@U@.png"
        assert own.ask("POST", path, thermal.read_bytes()).status == 201
        assert own.worker.places.zone == (32, False)
    shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.ptp(shown) > 240


def test_a_token(folder, params, pictures):
    token = "0123456789abcdef"
    with serving(folder, params, token=token) as own:
        for path in ("/", "/health", "/openapi.json"):
            assert own.ask("GET", path).status == 200
        wrong = ("other", "", token[:-1], token[:1], f"{token}0", f"0{token}", f"{token} 0")
        schemes = ("Bearer", f"Basic {token}", *(f"Bearer {each}" for each in wrong))
        for given in ({}, *({"Authorization": each} for each in schemes)):
            for method, path in (("GET", "/map"), ("GET", "/images/0"), ("POST", "/locate")):
                reply = own.ask(method, path, **given)
                assert (reply.status, reply.headers["www-authenticate"]) == (401, "Bearer")
        # Who has the token may ask by any name, from any page.
        right = {"Authorization": f"Bearer {token}", "Host": "a.example", "Origin": "https://b"}
        assert own.ask("POST", "/locate", pictures[0].read_bytes(), **right).status == 200


def test_images_are_added_for_good(own_map, params, pictures):
    data = pictures[4].read_bytes()  # of a place that the map does not have
    with serving(own_map, params, appends=True) as own:
        add = "/images?name=new/%C3%A9.jpg&east=12.5&north=5000001"
        before = own.ask("POST", "/locate?k=1", data).json["neighbours"][0]
        assert before["similarity"] < 1 - 10 * ROUNDING
        reply = own.ask("POST", add, data)
        assert reply.status == 201
        position = {"east": 12.5, "north": 5000001.0}
        wanted = {"number": 7, "name": "new/é.jpg", "position": position, "images": 8}
        assert wanted.items() <= reply.json.items()
        best = own.ask("POST", "/locate?k=1", data).json["neighbours"][0]
        assert (best["name"], best["position"], best["number"]) == ("new/é.jpg", position, 7)
        assert best["similarity"] == pytest.approx(1, abs=ROUNDING)
        assert own.ask("GET", "/images/7").status == 200
        for path, status, words in (
            (add, 409, "name: found 'new/é.jpg', expected one that neither an image nor a folder"),
            ("/images?name=new", 409, "name: found 'new', expected one"),
            ("/images?name=new/%C3%A9.jpg/b", 409, "name: found 'new/é.jpg/b'"),
            ("/images?name=../b.jpg", 400, "name: found"),
            ("/images?name=/b.jpg", 400, "name: found"),
            ("/images?name=.b", 400, "do not begin with a dot"),
            ("/images?name=a%0Ab", 400, "name: found 'a\\nb'"),
            ("/images?name=a%1Bb", 400, "name: found"),
            ("/images?name=a%5Cb", 400, "name: found"),
            ("/images?name=a%20/b", 400, "name: found"),
            ("/images?name=", 400, "name: found ''"),
            ("/images?name=" + 201 * "a", 400, "of parts of 1 to 200 bytes"),
            ("/images?name=" + "/".join([150 * "%C3%A9"] * 4), 400, "of parts of 1 to 200 bytes"),
            ("/images?name=" + "/".join(21 * "a"), 400, "name: found"),
            ("/images?name=%FF.jpg", 400, "name: found"),  # not UTF-8
            ("/images?name=walk.mp4%23t=12.5", 400, "name: found"),
            ("/images?name=b.jpg&name=c.jpg", 400, "name: found it 2 times, expected it once"),
            ("/images", 400, "name: field required"),
            ("/images?name=b.jpg&lat=1&lon=2", 400, "125 degrees of longitude from the middle of"),
            ("/images?name=b.jpg&x=1&y=2", 400, "found positions in x, y, expected east, north"),
            ("/images?name=b.jpg&lat=91&lon=2", 400, "lat: found '91'"),
            ("/images?name=b.jpg&lat=1&lon=180.5", 400, "lon: found '180.5'"),
            ("/images?name=b.jpg&lat=1_0&lon=2", 400, "lat: found '1_0', expected a number"),
            ("/images?name=b.jpg&east=1", 400, "found east, expected east and north, or lat"),
            ("/images?name=b.jpg&east=nan&north=1", 400, "east: found 'nan'"),
        ):
            reply = own.ask("POST", path, data)
            assert (reply.status, words in reply.json["error"]) == (status, True), reply
        # As `crisalad index` reads positions from names.
        named = own.ask("POST", "/images?name=@000033.00@5000000.00@.jpg", data).json
        assert named["position"] == {"east": 33.0, "north": 5e6}
    with Map.open(own_map) as places:
        assert [image.name for image in places.images[7:]] == [
            "new/é.jpg",
            "@000033.00@5000000.00@.jpg",
        ]
        assert places.images[7].bytes == len(data)
    assert (own_map / ADDED / "new" / "é.jpg").read_bytes() == data
    assert not (own_map.parent / "b.jpg").exists()


def test_adding_while_others_ask(own_map, params, pictures):
    data = pictures[1].read_bytes()
    with serving(own_map, params, appends=True) as own:

        def one(number):
            if number % 4:
                return own.ask("POST", "/locate?k=99", data)
            # Two of each name: one of them is told that it is too late.
            return own.ask("POST", f"/images?name={number // 8}.jpg", data)

        with concurrent.futures.ThreadPoolExecutor(CLIENTS) as pool:
            replies = list(pool.map(one, range(64)))
    added = [reply.status for reply in replies[::4]]
    assert sorted(added) == [201] * 8 + [409] * 8
    for number, reply in enumerate(replies):
        if number % 4:
            found = reply.json["neighbours"]
            assert 7 <= len(found) <= 15
            assert sorted(each["number"] for each in found) == list(range(len(found)))
    with Map.open(own_map) as places:
        assert len(places) == 15


def test_images_that_come_together_are_one_addition(own_map, params, pictures):
    go_on, data = threading.Event(), pictures[1].read_bytes()
    with serving(own_map, params, appends=True) as own:
        own.worker._thread.submit(go_on.wait, 60)
        with concurrent.futures.ThreadPoolExecutor(TOGETHER) as pool:
            paths = [f"/images?name={number}.jpg" for number in range(TOGETHER)]
            replies = pool.map(lambda path: own.ask("POST", path, data), paths)
            while len(own.worker._waiting) < TOGETHER:
                time.sleep(0.01)
            go_on.set()
            assert sorted(reply.json["number"] for reply in replies) == [7, 8, 9]
    with Map.open(own_map) as places:
        assert len(places) == 10
    assert len(list((own_map / SEGMENTS).glob("*.json"))) == 2


def test_an_addition_that_cannot_be_written_fails_alone(own_map, params, pictures, monkeypatch):
    data = pictures[1].read_bytes()
    with serving(own_map, params, appends=True) as own:
        append = own.worker.places.append

        def full(names, *arguments, **named):
            if "bad.jpg" in names:
                raise OSError("No space left on device")
            append(names, *arguments, **named)

        monkeypatch.setattr(own.worker.places, "append", full)
        paths = ["/locate", "/images?name=bad.jpg", *(f"/images?name={i}.jpg" for i in range(6))]
        with concurrent.futures.ThreadPoolExecutor(len(paths)) as pool:
            replies = list(pool.map(lambda path: own.ask("POST", path, data), paths))
        assert [reply.status for reply in replies] == [200, 500, *[201] * 6]
        assert not (own_map / ADDED / "bad.jpg").exists()
        monkeypatch.undo()
        assert own.ask("POST", "/images?name=bad.jpg", data).json["number"] == 13


def test_a_failed_addition_leaves_its_folder_to_others(own_map, params, pictures, monkeypatch):
    data = pictures[1].read_bytes()

    def full(*_, **__):
        raise OSError("No space left on device")

    with serving(own_map, params, appends=True) as own:
        monkeypatch.setattr(own.worker.places, "append", full)
        assert own.ask("POST", "/images?name=a/b/c.jpg", data).status == 500
        assert not (own_map / ADDED).exists()
        monkeypatch.undo()
        assert own.ask("POST", "/images?name=a/b", data).status == 201


def test_a_path_that_is_too_long_is_refused_alone(own_map, params, pictures):
    deep = own_map.parent.joinpath(*[200 * "d"] * 15, "map")
    deep.parent.mkdir(parents=True)
    own_map.rename(deep)
    data, long = pictures[1].read_bytes(), "/".join(["a" * 190] * 5)
    with serving(deep, params, appends=True) as own:
        paths = ["/locate", f"/images?name={long}", "/images?name=a.jpg", f"/images?name=b/{long}"]
        with concurrent.futures.ThreadPoolExecutor(len(paths)) as pool:
            replies = list(pool.map(lambda path: own.ask("POST", path, data), paths))
    assert [reply.status for reply in replies] == [200, 400, 201, 400]
    assert replies[1].json["error"] == "name: found 954 bytes, expected fewer in this map"


@pytest.mark.parametrize("replaced", [False, True])
def test_a_map_that_was_moved_takes_no_images(own_map, params, pictures, replaced):
    data, moved = pictures[1].read_bytes(), own_map.with_name("moved.map")
    with serving(own_map, params, appends=True) as own:
        assert own.ask("GET", "/health").status == 200
        own_map.rename(moved)
        if replaced:
            shutil.copytree(moved, own_map)
        for method, path, status in (("POST", "/images?name=a.jpg", 500), ("GET", "/health", 503)):
            reply = own.ask(method, path, data if method == "POST" else None)
            assert reply.status == status
            assert reply.json["error"].startswith("the map or the model failed; ")
        if not replaced:
            assert not own_map.exists()
            moved.rename(own_map)
            assert own.ask("GET", "/health").status == 200
            assert own.ask("POST", "/images?name=a.jpg", data).status == 201
    with Map.open(own_map) as places:
        assert len(places) == (7 if replaced else 8)
    assert (own_map / ADDED).exists() is not replaced


def test_each_question_of_a_batch_has_its_own_number_of_answers(service, pictures):
    go_on, data = threading.Event(), pictures[1].read_bytes()
    service.worker._thread.submit(go_on.wait, 60)
    with concurrent.futures.ThreadPoolExecutor(TOGETHER) as pool:
        replies = pool.map(lambda k: service.ask("POST", f"/locate?k={k}", data), (1, 6, 3))
        while len(service.worker._waiting) < TOGETHER:
            time.sleep(0.01)
        go_on.set()
        assert [len(reply.json["neighbours"]) for reply in replies] == [1, 6, 3]


def test_too_many_are_told_to_come_again(folder, params, pictures):
    with serving(folder, params, most_waiting=0) as own:
        reply = own.ask("POST", "/locate", pictures[0].read_bytes())
    assert (reply.status, reply.headers["retry-after"]) == (503, "1")
    assert "try again" in reply.json["error"]


def test_a_map_that_fails_tells_the_client_nothing_of_the_machine(
    folder, params, pictures, capfd, monkeypatch
):
    def fail(*_, **__):
        raise InputError(f"{folder}: damaged")

    with serving(folder, params) as own:
        monkeypatch.setattr(own.worker.places, "search", fail)
        reply = own.ask("POST", "/locate", pictures[0].read_bytes())
        assert reply.status == 500
        assert str(folder) not in reply.data.decode()
        assert f"{folder}: damaged" in capfd.readouterr().err
        monkeypatch.undo()
        assert own.ask("POST", "/locate", pictures[0].read_bytes()).status == 200


def test_requests_in_flight_are_answered_at_the_end(folder, params, pictures, monkeypatch):
    inside, go_on = threading.Event(), threading.Event()
    with serving(folder, params) as own:
        search = own.worker.places.search

        def slow(*arguments, **options):
            inside.set()
            assert go_on.wait(60)
            return search(*arguments, **options)

        monkeypatch.setattr(own.worker.places, "search", slow)
        with concurrent.futures.ThreadPoolExecutor(1) as pool:
            reply = pool.submit(own.ask, "POST", "/locate", pictures[0].read_bytes())
            assert inside.wait(60)
            own.stop.number = signal.SIGTERM
            for _ in range(600):  # until nobody is let in any more
                try:
                    own.ask("GET", "/health")
                except ConnectionError:
                    break
                time.sleep(0.1)
            else:
                pytest.fail("the service still takes requests")
            go_on.set()
            assert reply.result().status == 200


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code", "words"),
    [(signal.SIGTERM, 143, "ended by SIGTERM"), (signal.SIGINT, 130, "interrupted")],
)
def test_the_command_says_where_it_is_and_ends_at_a_signal(own_map, pictures, number, code, words):
    command = [sys.executable, "-m", "crisalad_jax", "serve", "--map", str(own_map), "--port", "0"]
    with subprocess.Popen(
        [*command, "--append", "--batch-size", "1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout
        assert process.stderr
        line = process.stdout.readline()
        found = re.match(r"http://127\.0\.0\.1:(\d+): answers for .*, and adds images to it", line)
        assert found, line
        with urllib.request.urlopen(
            f"http://127.0.0.1:{found[1]}/locate", pictures[0].read_bytes(), timeout=60
        ) as answer:
            assert len(json.load(answer)["neighbours"]) == 5
        process.send_signal(number)
        assert process.wait(60) == code
        assert process.stderr.read().splitlines()[-1] == f"crisalad: {words}"
