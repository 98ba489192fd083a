"""Messages about optional dependencies (extras) that are not installed."""

from collections.abc import Mapping

_CLI = ("tyro", "rich", "shtab")
EXTRAS: Mapping[str, tuple[str, ...]] = {
    "report": ("jinja2", "matplotlib", *_CLI),
    "train": ("optax", "orbax", "numba", "tensorboardX", "matplotlib", *_CLI),
    "maps": ("faiss", "h5py", "PIL", "yaml", *_CLI),
    "robot": ("rosbags", "rerun", "fsspec", *_CLI),
    "export": ("flatbuffers", *_CLI),
    "onnx": ("onnx", "onnxruntime", *_CLI),
    "openvino": ("openvino", "onnx", *_CLI),
    "serve": ("fastapi", "uvicorn", "python_multipart", *_CLI),
    "data": ("huggingface_hub", "kagglehub", *_CLI),
    "ray": ("ray", "grpc", *_CLI),
    "milvus": ("pymilvus", "milvus_lite"),
    "convert": ("torch", *_CLI),
}
"""Modules that each extra installs; of extras that share a module, the smallest comes first."""


def missing_extra(error: ModuleNotFoundError, what: str) -> str:
    """Return a message, beginning with `what`, on the extra that installs a missing module.

    Raises:
        ModuleNotFoundError: the error itself, if no extra has the module.
    """
    name = (error.name or "").partition(".")[0]
    extra = next((extra for extra, modules in EXTRAS.items() if name in modules), None)
    if extra is None:
        raise error
    others = "" if extra in ("milvus", "ray", "convert") else " (or [all])"
    return (
        f"{what}: found no module {name}, expected it with the extra {extra}: "
        f"pip install 'crisalad-jax[{extra}]'{others}"
    )
