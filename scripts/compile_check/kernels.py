"""Count cycles of Pallas kernels on a TPU, which libtpu doesn't estimate in the program's text.

libtpu logs how many bundles each operation was scheduled as. A TPU issues one bundle per cycle, so
bundles times grid steps are a kernel's cycles, if it never waits for memory.
"""

import atexit
import base64
import functools
import math
import os
import pathlib
import re
import shutil
import tempfile
from collections.abc import Mapping

from scripts.compile_check.counts import KERNEL
from scripts.compile_check.hlo import Module, Operation

_OPTIONS = (
    "--xla_jf_dump_to={folder}",
    "--xla_jf_dump_llo_text=true",
    "--xla_jf_dump_llo_pass_label_regex=.*final_bundles.*",
)
_FILE = re.compile(r"\d+-(.+)-\d+-schedule-analysis_final_bundles\.txt")
_BUNDLES = re.compile(r"non empty scheduled bundles:\s*(\d+)")


@functools.cache
def dump_folder() -> pathlib.Path:
    """Make the folder that libtpu writes to, once, before libtpu is loaded; removed at exit."""
    folder = pathlib.Path(tempfile.mkdtemp(prefix="crisalad-kernels-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    given = os.environ.get("LIBTPU_INIT_ARGS", "")
    ours = " ".join(_OPTIONS).format(folder=folder)
    os.environ["LIBTPU_INIT_ARGS"] = f"{given} {ours}".strip()
    return folder


def kernel_cycles(module: Module) -> Mapping[str, int]:
    """Return the cycles of the kernels of the program that was compiled last, by name.

    Kernels for which libtpu wrote nothing are missing, for example if it was loaded before
    `dump_folder`.
    """
    bundles = {}
    for file in dump_folder().iterdir():
        name, found = _FILE.fullmatch(file.name), None
        if name is not None:
            found = _BUNDLES.search(file.read_text(errors="replace"))
        if name is not None and found is not None:
            bundles[name[1]] = int(found[1])
        file.unlink()
    kernels = [each for each in module.operations() if each.target == KERNEL]
    # Kernels with the same body are compiled once, under the name of one of them.
    by_body = {_body(each): bundles[each.name] for each in kernels if each.name in bundles}
    return {
        each.name: by_body[_body(each)] * _grid_steps(_body(each))
        for each in kernels
        if _body(each) in by_body
    }


def _body(kernel: Operation) -> str:
    found = re.search(r'"body":"([^"]*)"', kernel.attributes)
    return "" if found is None else found[1]


@functools.cache
def _grid_steps(body: str) -> int:
    """Read the number of a kernel's grid steps from its body, a Mosaic module in MLIR bytecode.

    JAX has no public reader for it.
    """
    from jax._src.lib import tpu  # pyright: ignore[reportPrivateImportUsage]
    from jax._src.lib.mlir import ir  # pyright: ignore[reportPrivateImportUsage]

    with ir.Context() as context:
        context.allow_unregistered_dialects = True
        tpu.register_dialect(context)
        text = str(ir.Module.parse(base64.b64decode(body)))
    bounds = re.search(r"iteration_bounds = array<i64: ([\d, ]+)>", text)
    return 1 if bounds is None else math.prod(map(int, bounds[1].split(",")))
