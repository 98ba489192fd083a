"""NetVLAD's MATLAB file, written by scipy, against hloc's torch module."""

import dataclasses
import pathlib

import jax
import numpy as np
import pytest
import scipy.io

from crisalad_jax.checkpoints.formats import infer, public_shapes, to_params
from crisalad_jax.checkpoints.matlab_io import CONVOLUTIONS, read_matlab
from crisalad_jax.checkpoints.public import convert, read_checkpoint
from crisalad_jax.nn.aggregators.vlad import NetVladConfig
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.utils.errors import InputError
from parity import zoo
from tests.random_checkpoints import blank

MEAN = (123.68, 116.779, 103.939)
FORMAT = "netvlad-hloc"
State = dict[str, np.ndarray]


def write_matlab(path: pathlib.Path, hloc: State, average: np.ndarray) -> None:
    """Write the numbers of hloc's module as MATLAB's file has them, by hloc's own comments."""
    layers = [{"name": f"layer {number}", "weights": np.empty(0, object)} for number in range(34)]

    def put(number: int, *arrays: np.ndarray) -> None:
        layers[number]["weights"] = np.empty(2, object)
        layers[number]["weights"][:] = arrays

    for number in CONVOLUTIONS:
        kernel = hloc[f"backbone.{number}.weight"].transpose(2, 3, 1, 0)
        put(number, kernel, hloc[f"backbone.{number}.bias"])
    put(30, hloc["netvlad.score_proj.weight"][:, :, 0].T, -hloc["netvlad.centers"])
    put(33, hloc["whiten.weight"].T, hloc["whiten.bias"])
    meta = {"normalization": {"averageImage": average}}
    scipy.io.savemat(path, {"net": {"layers": np.array(layers), "meta": meta}}, oned_as="column")


def small_state() -> State:
    """A whole NetVLAD of two clusters and three numbers."""
    shapes = {name: tuple(shape) for name, shape in zoo.layout("netvlad_vgg16_hloc").items()}
    config = dataclasses.replace(
        infer(blank(shapes), source="zoo")[1],
        aggregator=NetVladConfig(clusters=2),
        projection=ProjectionConfig(dim=3),
    )
    rng = np.random.default_rng(1)
    shapes = public_shapes(config, FORMAT)
    return {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


def test_what_is_no_network(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "other.mat"
    for content in ({"dbStruct": {"whichSet": "test"}}, {"net": np.zeros(3)}):
        scipy.io.savemat(path, content)
        with pytest.raises(InputError, match=r"other.mat: found another network .*expected a MATL"):
            read_matlab(path)
    path.write_bytes(b"no MATLAB at all, but text of some length" * 10)
    with pytest.raises(InputError, match=r"other.mat: not a whole MATLAB file"):
        read_matlab(path)


@pytest.mark.parametrize("first", [MEAN, (122.74493, 114.89767, 101.59195), (0, 0, 0)])
def test_a_file_is_hlocs_module_and_the_mean_its_first_pixel(tmp_path: pathlib.Path, first) -> None:
    """hloc subtracts the pixel at [0, 0] from all, whatever the image's size."""
    average = np.random.default_rng(0).uniform(0, 255, (4, 6, 3)).astype(np.float32)
    average[0, 0] = first
    state = small_state()
    write_matlab(tmp_path / "net.mat", state, average)
    found = read_matlab(tmp_path / "net.mat").state
    assert found.keys() == state.keys()
    for name, array in state.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == np.float32
    read = read_checkpoint(tmp_path / "net.mat")
    mean = np.float32(255) * np.array(read.config.preprocessing.mean)
    np.testing.assert_array_equal(mean.astype(np.float32), average[0, 0])
    params, _ = to_params(state, read.config, FORMAT, source="hloc")
    jax.tree.map(np.testing.assert_array_equal, read.params, params)
    # hloc's descriptor has the first channel of both clusters, then the second; ours has clusters.
    whitening = np.asarray(params.projection.weight).reshape(2, -1, 3)
    np.testing.assert_array_equal(whitening[1, 7], state["whiten.weight"][:, 2 * 7 + 1])
    convert(tmp_path / "net.mat", tmp_path / "ours.safetensors")
    assert read_checkpoint(tmp_path / "ours.safetensors").config == read.config


def test_every_cut_is_told(tmp_path: pathlib.Path) -> None:
    write_matlab(tmp_path / "net.mat", small_state(), np.zeros((2, 3, 3), np.float32))
    whole = (tmp_path / "net.mat").read_bytes()
    for size in range(8, len(whole) - 8, len(whole) // 10):
        (tmp_path / "cut.mat").write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"cut\.mat"):
            read_matlab(tmp_path / "cut.mat")
