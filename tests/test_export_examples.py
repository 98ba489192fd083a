"""The examples of exported programs run without JAX, in Python and in C++."""

import importlib.util
import pathlib
import shutil
import subprocess
import sys

import numpy as np
import PIL.Image
import pytest

from crisalad_jax.checkpoints.export import ExportConfig, write_export
from crisalad_jax.nn.model import Crisalad, Model, describe, self_mask
from tests.checkpoints.test_export import TOLERANCE, pictures
from tests.conftest import MODEL

pytestmark = pytest.mark.usefixtures("symbolic_shapes")

EXAMPLES = pathlib.Path(__file__).parents[1] / "examples" / "export"
WITHOUT_JAX = (
    "import runpy, sys\n"
    "sys.modules.update(dict.fromkeys(('jax', 'jaxlib', 'crisalad_jax')))\n"
    "sys.argv = sys.argv[1:]\n"
    "runpy.run_path(sys.argv[0], run_name='__main__')\n"
)


def expected(params: Crisalad) -> np.ndarray:
    return np.asarray(describe(params, pictures(2), MODEL, mask=self_mask(2)))


@pytest.mark.slow
def test_python_with_onnxruntime(params: Crisalad, tmp_path: pathlib.Path):
    """Pictures of the model's size, stored without loss: the same pixels, so the same numbers."""
    write_export(tmp_path / "export", Model(params, MODEL), ExportConfig(format="onnx"))
    names = ["a.png", "b.png"]
    for name, pixels in zip(names, pictures(2), strict=True):
        PIL.Image.fromarray(pixels).save(tmp_path / name)
    command = [sys.executable, "-c", WITHOUT_JAX, EXAMPLES / "describe.py", "export", *names]
    subprocess.run(command, cwd=tmp_path, check=True)
    found = [np.load(tmp_path / name) for name in ("a.npy", "b.npy")]
    np.testing.assert_allclose(found, expected(params), rtol=0, atol=TOLERANCE)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake")
def test_cpp_with_openvino(params: Crisalad, tmp_path: pathlib.Path):
    write_export(tmp_path / "export", Model(params, MODEL), ExportConfig(format="openvino"))
    spec = importlib.util.find_spec("openvino")
    assert spec is not None
    assert spec.origin is not None
    cmake = pathlib.Path(spec.origin).parent / "cmake"
    build = tmp_path / "build"
    for step in (["-S", EXAMPLES, "-B", build, f"-DOpenVINO_DIR={cmake}"], ["--build", build]):
        subprocess.run(["cmake", *step], check=True, capture_output=True)
    height, width = map(str, MODEL.image_size)
    command = [build / "describe", tmp_path / "export" / "describe.xml", height, width]
    outputs = [
        subprocess.run(command, input=pixels.tobytes(), capture_output=True, check=True).stdout
        for pixels in pictures(2)
    ]
    found = [np.frombuffer(each, np.float32) for each in outputs]
    np.testing.assert_allclose(found, expected(params), rtol=0, atol=TOLERANCE)
