"""Docstrings of the public names: whole, and their examples run."""

import doctest
import importlib
import inspect
import pathlib

import cv2
import numpy as np
import pytest

import crisalad_jax
import crisalad_jax.sinkhorn
from tests.conftest import write_city

ROOT = pathlib.Path(__file__).parents[1]
PUBLIC = {
    f"{module.__name__.removeprefix('crisalad_jax').removeprefix('.')}.{name}".lstrip("."): getattr(
        module, name
    )
    for module in (crisalad_jax, crisalad_jax.sinkhorn)
    for name in getattr(module, "__all__", vars(module))
    if not name.startswith("_") and not inspect.ismodule(getattr(module, name))
}
DOCUMENTED = {
    name: value
    for name, value in PUBLIC.items()
    if inspect.isclass(value) or inspect.isfunction(value) or hasattr(value, "__wrapped__")
}
FUNCTIONS = {name: value for name, value in DOCUMENTED.items() if not inspect.isclass(value)}
SLOW = {
    *("Map", "adapt", "attend_across_images", "build_vocabulary", "convert", "distil"),
    *("evaluate", "extract"),
    *(
        "evaluation_record",
        "extract_features",
        "extract_tokens",
        "fit",
        "gradient_norms",
        "image_pairs",
    ),
    *("index",),
    *("init_train_state", "transport_masses", "write_report"),
    *("merge_params", "publish", "query", "query_live", "read_backbone", "show_attention"),
    *("show_image_attention", "show_transport", "split_params", "train", "write_export"),
}
"""Examples that make, train or run a model; `describe` and `make_train_step` stand for them."""
MINUTES = {"compare"}
"""Examples would train for minutes: docs/comparison.md has one."""


@pytest.mark.parametrize("name", DOCUMENTED)
def test_a_public_docstring_is_whole(name):
    value = DOCUMENTED[name]
    text = inspect.getdoc(value)
    assert text, name
    first = text.splitlines()[0]
    assert first.endswith("."), first
    if name in FUNCTIONS:
        signature = inspect.signature(value)
        assert not signature.parameters or "\nArgs:\n" in text
        nothing = signature.return_annotation in (None, "None")
        assert nothing or "\nReturns:\n" in text or "\nYields:\n" in text
        arguments = text.partition("\nArgs:\n")[2].partition("\n\n")[0]
        for parameter in signature.parameters:
            assert f"    {parameter}:" in arguments or f"    **{parameter}:" in arguments, parameter
        assert "\nExample:\n" in text or name in MINUTES


pytestmark = pytest.mark.usefixtures("own_parts")


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("pictures")
    generator = np.random.default_rng(0)
    for number in range(4):
        picture = generator.integers(0, 256, (60, 80, 3), np.uint8)
        assert cv2.imwrite(str(folder / f"{number}.png"), picture)
    return folder


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in SLOW else ())
        for name, value in DOCUMENTED.items()
        if ">>>" in (inspect.getdoc(value) or "")
    ],
)
def test_an_example_runs(name, pictures, tmp_path):
    value = DOCUMENTED[name]
    module = importlib.import_module(value.__module__)
    names = {**vars(module), "pictures": pictures, "folder": tmp_path}
    if "places" in inspect.getdoc(value):
        names["places"] = write_city(tmp_path / "places")
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    tests = doctest.DocTestFinder(recurse=False).find(
        inspect.unwrap(value), name, module=False, globs=names
    )
    assert sum(len(test.examples) for test in tests)
    printed = []
    for test in tests:
        runner.run(test, out=printed.append)
    assert not runner.failures, "".join(printed)
