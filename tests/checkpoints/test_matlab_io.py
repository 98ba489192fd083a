"""NetVLAD's MATLAB file, against scipy's reader and hloc's torch module."""

import dataclasses
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io

from crisalad_jax import describe
from crisalad_jax.checkpoints.layouts import infer, public_shapes, to_params, to_state
from crisalad_jax.checkpoints.layouts.cnn import vgg_numbers
from crisalad_jax.checkpoints.matlab_io import AVERAGE, read_matlab, write_matlab
from crisalad_jax.checkpoints.torch_io import convert, read_checkpoint, write_checkpoint
from crisalad_jax.nn.aggregators.vlad import NetVladConfig
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.utils.errors import InputError
from parity import zoo

MEAN = (123.68, 116.779, 103.939)


def matlab_state(hloc: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The numbers of hloc's module as MATLAB's file has them, by hloc's own comments."""
    average = np.broadcast_to(np.float32(MEAN), (224, 224, 3))
    state = {AVERAGE: np.ascontiguousarray(average)}
    for _, number in vgg_numbers():
        layer = f"net.layers[{number}]"
        state[f"{layer}.weights[0]"] = hloc[f"backbone.{number}.weight"].transpose(2, 3, 1, 0)
        state[f"{layer}.weights[1]"] = hloc[f"backbone.{number}.bias"]
    state["net.layers[30].weights[0]"] = hloc["netvlad.score_proj.weight"][:, :, 0].T
    state["net.layers[30].weights[1]"] = -hloc["netvlad.centers"]
    state["net.layers[33].weights[0]"] = hloc["whiten.weight"].T
    state["net.layers[33].weights[1]"] = hloc["whiten.bias"]
    return state


def small_network(average: np.ndarray) -> dict[str, np.ndarray]:
    """A whole NetVLAD of two clusters and three numbers, with an average image."""
    config = dataclasses.replace(
        infer(blank(zoo.layout("netvlad_vgg16_hloc_mat")), source="zoo")[1],
        aggregator=NetVladConfig(clusters=2),
        projection=ProjectionConfig(dim=3),
    )
    rng = np.random.default_rng(1)
    shapes = public_shapes(config, "netvlad-matlab")
    state = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    return state | {AVERAGE: average}


def blank(shapes: dict[str, list[int]]) -> dict[str, np.ndarray]:
    return {name: np.broadcast_to(np.float32(1), tuple(shape)) for name, shape in shapes.items()}


def tiny() -> dict[str, np.ndarray]:
    """A network of two layers, which no model has: the file's form alone."""
    rng = np.random.default_rng(0)
    return {
        AVERAGE: rng.uniform(0, 255, (2, 3, 3)).astype(np.float32),
        "net.layers[0].weights[0]": rng.normal(size=(3, 3, 3, 4)).astype(np.float32),
        "net.layers[0].weights[1]": rng.normal(size=4).astype(np.float32),
        "net.layers[2].weights[0]": rng.normal(size=(5, 4)).astype(np.float32),
        "net.layers[2].weights[1]": rng.normal(size=4).astype(np.float32),
    }


def test_a_written_file_is_what_scipy_and_we_read(tmp_path: pathlib.Path) -> None:
    path, state = tmp_path / "net.mat", tiny()
    write_matlab(path, state, None)
    network = scipy.io.loadmat(path, struct_as_record=False, squeeze_me=True)["net"]
    assert len(network.layers) == 3
    for number, i in ((0, 0), (0, 1), (2, 0), (2, 1)):
        expected = state[f"net.layers[{number}].weights[{i}]"]
        np.testing.assert_array_equal(network.layers[number].weights[i], expected)
    np.testing.assert_array_equal(network.meta.normalization.averageImage, state[AVERAGE])
    found = read_matlab(path).state
    assert found.keys() == state.keys()
    for name, array in state.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == np.float32


def test_what_is_no_network(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "other.mat"
    scipy.io.savemat(path, {"dbStruct": {"whichSet": "test"}})
    scipy.io.savemat(tmp_path / "numbers.mat", {"net": np.zeros(3)})
    with pytest.raises(
        InputError, match=r"numbers.mat: found a net without layers or averageImage"
    ):
        read_matlab(tmp_path / "numbers.mat")
    with pytest.raises(InputError, match=r"other.mat: found no 'net', expected a MATLAB file of a"):
        read_matlab(path)
    path.write_bytes(b"no MATLAB at all, but text of some length" * 10)
    with pytest.raises(InputError, match=r"other.mat: not a whole MATLAB file"):
        read_matlab(path)
    with pytest.raises(InputError, match=r"none.mat: found no such file"):
        read_matlab(tmp_path / "none.mat")


def test_every_cut_is_told(tmp_path: pathlib.Path) -> None:
    write_matlab(tmp_path / "net.mat", tiny(), None)
    whole = (tmp_path / "net.mat").read_bytes()
    for size in range(8, len(whole) - 8, len(whole) // 40):
        (tmp_path / "cut.mat").write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"cut\.mat"):
            read_matlab(tmp_path / "cut.mat")


@pytest.mark.parametrize(
    "first", [(123.68, 116.779, 103.939), (122.74493, 114.89767, 101.59195), (0, 0, 0)]
)
def test_the_mean_is_the_files_first_pixel_to_the_bit(tmp_path: pathlib.Path, first) -> None:
    """hloc subtracts the pixel at [0, 0] from all, whatever the image's size."""
    average = np.random.default_rng(0).uniform(0, 255, (4, 6, 3)).astype(np.float32)
    average[0, 0] = first
    state = small_network(average)
    write_matlab(tmp_path / "net.mat", state, None)
    read = read_checkpoint(tmp_path / "net.mat")
    mean = np.float32(255) * np.array(read.config.preprocessing.mean)
    np.testing.assert_array_equal(mean.astype(np.float32), average[0, 0])
    convert(tmp_path / "net.mat", tmp_path / "ours.safetensors")
    convert(tmp_path / "ours.safetensors", tmp_path / "back.mat")
    back = read_matlab(tmp_path / "back.mat").state
    assert back.keys() == state.keys()
    for name, array in state.items():
        np.testing.assert_array_equal(back[name], array)


def test_another_image_size_comes_back(tmp_path: pathlib.Path) -> None:
    write_matlab(tmp_path / "net.mat", small_network(np.zeros((4, 6, 3), np.float32)), None)
    read = read_checkpoint(tmp_path / "net.mat")
    config = dataclasses.replace(read.config, image_size=(128, 160))
    write_checkpoint(tmp_path / "back.mat", read.params, config, "netvlad-matlab", read.extras)
    assert read_checkpoint(tmp_path / "back.mat").config == config


def test_a_model_from_another_file_is_written_with_its_own_mean() -> None:
    state = small_network(np.full((1, 1, 3), 100, np.float32))
    config = infer(state, source="net")[1]
    params, _ = to_params(state, config, "netvlad-matlab", source="net")
    written = to_state(params, config, "netvlad-matlab", {})
    assert written[AVERAGE].shape == (224, 224, 3)
    np.testing.assert_array_equal(written[AVERAGE], np.float32(100))


@pytest.mark.parametrize("shape", [(3,), (2, 3, 4)])
def test_an_average_that_is_no_image_is_refused(shape: tuple[int, ...]) -> None:
    state = small_network(np.zeros(shape, np.float32))
    config = infer(state, source="net.mat")[1]
    with pytest.raises(
        InputError, match=r"net\.mat: .*averageImage found .*expected \(224, 224, 3\)"
    ):
        to_params(state, config, "netvlad-matlab", source="net.mat")


@pytest.mark.slow
def test_matlabs_file_is_hlocs_module_and_goes_back(tmp_path: pathlib.Path) -> None:
    """At full size: 150 million numbers."""
    name = "netvlad_vgg16_hloc"
    hloc, golden = zoo.random_state(name), zoo.golden(name)
    state = matlab_state(hloc)
    shapes = zoo.layout(f"{name}_mat")
    assert {k: v.size for k, v in state.items()} == {k: np.prod(s) for k, s in shapes.items()}
    write_matlab(tmp_path / "Pitts30K_struct.mat", state, None)
    read = read_checkpoint(tmp_path / "Pitts30K_struct.mat")
    assert read.layout == "netvlad-matlab"
    layout, config = infer(hloc, source="hloc")
    assert (layout, read.config) == ("netvlad-hloc", config)
    params, _ = to_params(hloc, config, layout, source="hloc")
    jax.tree.map(np.testing.assert_array_equal, read.params, params)
    found = describe(jax.tree.map(jnp.asarray, params), golden["images"], config)
    # Forty times what float32 makes here, as in parity/test_zoo.py.
    error = np.linalg.norm(found - golden["descriptor"])
    assert error < 2e-5 * np.linalg.norm(golden["descriptor"])

    convert(tmp_path / "Pitts30K_struct.mat", tmp_path / "ours.safetensors")
    convert(tmp_path / "ours.safetensors", tmp_path / "back.mat")
    back = read_matlab(tmp_path / "back.mat").state
    assert back.keys() == state.keys()
    for key, array in state.items():
        np.testing.assert_array_equal(back[key], array)
