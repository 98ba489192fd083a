"""Describing on a Ray cluster, compared bit for bit with describing in one process."""

import pathlib
import pickle
import subprocess
import sys

import numpy as np
import pytest

from crisalad_jax.checkpoints.export import ExportConfig, write_export
from crisalad_jax.checkpoints.runtime import open_runtime
from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval import on_cluster
from crisalad_jax.retrieval.describe import describe_files
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.retrieval.extract import extract
from crisalad_jax.retrieval.on_cluster import Describing
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL, random_params, write_picture
from tests.ray_nodes import ray_nodes

COUNT = 26


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("images")
    for number in range(COUNT):
        write_picture(folder / f"{number:02d}.png", number)
    (folder / "05.png").write_bytes(b"no picture")
    return folder


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(random_params(MODEL), MODEL)


def test_extract_on_a_local_cluster(images, model, monkeypatch):
    """The one quick test that starts Ray; others are slow."""
    monkeypatch.setattr(on_cluster, "SEGMENT", 8)  # several pieces
    how = {"reading": Reading(batch_size=4, on_bad_image="skip", quiet=True)}
    here = extract(model, images, **how)
    there = extract(model, images, cluster="local", **how)
    assert there.names == here.names
    assert there.skipped == here.skipped == ["05.png"]
    np.testing.assert_array_equal(there.descriptors, here.descriptors)


def test_pieces_are_whole_batches(images, model, monkeypatch):
    """A piece is what a node gets: its batches are those of one process."""
    paths = sorted(images.iterdir())
    how = Describing(describer_of(model), Reading(batch_size=4, on_bad_image="skip"))
    batches = list(how.stream(paths))
    for first in range(0, COUNT, 8):
        whole = how.piece((first, paths[first : first + 8]))
        same = batches[first // 4 : first // 4 + 2]
        np.testing.assert_array_equal(whole.indices, np.concatenate([b.indices for b in same]))
        np.testing.assert_array_equal(
            whole.descriptors, np.concatenate([b.descriptors for b in same])
        )
        np.testing.assert_array_equal(
            whole.unreadable, np.concatenate([b.unreadable for b in same])
        )


def test_an_image_that_only_nodes_cannot_read(images, model):
    how = Describing(describer_of(model), Reading(on_bad_image="skip"))
    how._check_unreadable(images / "05.png")  # nobody can
    with pytest.raises(InputError, match=r"00\.png: a node of the cluster cannot read it"):
        how._check_unreadable(images / "00.png")


def test_a_describer_of_jax_by_pickle(images, model):
    sent = pickle.loads(pickle.dumps(describer_of(model)))
    file = images / "00.png"
    np.testing.assert_array_equal(describe_files(sent, file), describe_files(model, file))
    assert sent.digest == describer_of(model).digest


@pytest.mark.usefixtures("symbolic_shapes")
def test_a_runtime_by_pickle(images, model, tmp_path):
    pytest.importorskip("onnxruntime")
    write_export(tmp_path / "onnx", model, ExportConfig(format="onnx"))
    runtime = open_runtime(tmp_path / "onnx", "onnxruntime")
    sent = pickle.dumps(runtime)
    expected = describe_files(runtime, images / "00.png")
    for path in (tmp_path / "onnx").iterdir():  # another machine does not have them
        path.unlink()
    np.testing.assert_array_equal(describe_files(pickle.loads(sent), images / "00.png"), expected)


def crisalad(nodes, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "crisalad_jax", *arguments],
        env=dict(nodes.environment),
        capture_output=True,
        text=True,
        timeout=500,
    )


@pytest.fixture(scope="module")
def weights(tmp_path_factory, model) -> pathlib.Path:
    path = tmp_path_factory.mktemp("weights") / "weights.safetensors"
    save_weights(path, model)
    return path


@pytest.mark.slow
def test_two_nodes_write_what_one_process_writes(tmp_path, weights):
    """Of pictures enough for three pieces; nodes have one core, and the process has all."""
    images = tmp_path / "images"
    for number in range(600):
        write_picture(images / "sub" / f"{number:03d}.jpg", number)
    (images / "sub" / "300.jpg").write_bytes(b"no picture")
    common = ["--weights", str(weights), "--images", str(images), "--on-bad-image", "skip"]
    with ray_nodes() as nodes:
        for name, flags in {
            "d.npy": ["extract"],
            "window.npy": ["extract", "--grouping", "window", "--batch-size", "4"],
            "map": ["index"],
        }.items():
            written, said = [], []
            for place in ("here", "there"):
                cluster = nodes.client if name == "d.npy" else nodes.address
                on = ["--cluster", cluster] if place == "there" else []
                out = tmp_path / place / name
                out.parent.mkdir(exist_ok=True)
                done = crisalad(nodes, *flags, *common, "--quiet", *on, "--out", str(out))
                assert done.returncode == 0, done.stderr
                # A map is cut into other files where an image cannot be read.
                files = [out] if out.is_file() else sorted(out.glob("**/*.npy"))
                written.append(np.concatenate([np.load(each) for each in files]))
                said.append(done.stderr.replace(str(out), "OUT"))
            np.testing.assert_array_equal(*written)
            assert len(written[0]) >= 599
            assert said[0] == said[1]


@pytest.mark.slow
def test_bad_input_on_a_node_is_one_line(images, weights, tmp_path):
    with ray_nodes(1) as nodes:
        out = str(tmp_path / "d.npy")
        common = ["extract", "--weights", str(weights), "--images", str(images), "--out", out]
        done = crisalad(nodes, *common, "--cluster", nodes.address, "--quiet")
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2
    assert line.startswith("crisalad: node ")
    assert f"{images}/05.png: " in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_an_object_store_without_credentials_on_a_node(tmp_path, weights, images):
    """The driver has them, and lists the images; the nodes have not."""
    moto = pytest.importorskip("moto.server")
    fsspec = pytest.importorskip("fsspec")
    pytest.importorskip("s3fs")
    server = moto.ThreadedMotoServer(port=0)
    server.start()
    try:
        host, port = server.get_host_and_port()
        secret = {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b"}
        address = {"AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_EC2_METADATA_DISABLED": "true"}
        files = fsspec.filesystem(
            "s3", key="a", secret="b", endpoint_url=address["AWS_ENDPOINT_URL"]
        )
        files.mkdir("bucket")
        for number in range(3):
            files.put(str(images / f"{number:02d}.png"), f"bucket/{number}.png")
        common = ["extract", "--weights", str(weights), "--images", "s3://bucket", "--quiet"]
        with ray_nodes(environments=[{**address, **secret}, address]) as nodes:
            driver = nodes._replace(environment={**nodes.environment, **address, **secret})
            out = ["--out", str(tmp_path / "d.npy"), "--cluster", nodes.address]
            done = crisalad(driver, *common, *out)
    finally:
        server.stop()
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2
    assert line.startswith("crisalad: --cluster: node ")
    assert "cannot read s3://bucket/0.png, as this machine can (NoCredentialsError" in line
