"""Imports point one way, and the light core stays light: read from the source, no module is run."""

import ast
import pathlib
import subprocess
import sys
from collections.abc import Iterator

import pytest

PACKAGE = "crisalad_jax"
SOURCE = pathlib.Path(__file__).parents[1] / PACKAGE

# A module imports from layers above its own line only; a package, from itself as well.
LAYERS = (
    ("errors", "cores"),
    ("config", "pytree", "files", "progress", "platform", "processes"),
    ("sinkhorn", "losses", "serial", "data", "metrics", "stops", "groupings", "scores", "rows"),
    ("nn", "same_place"),
    ("model",),
    ("checkpoint", "states", "costs", "layouts"),
    ("convert", "export"),
    ("classification",),
    ("training", "retrieval", "descriptors", "pca"),
    ("results", "approximate", "similarity", "reranking"),
    ("evaluation", "report", "pairs", "stores", "vocabulary"),
    ("map_description",),
    ("maps",),
    ("indexing",),
    ("fit",),
    ("demo",),
    ("comparison",),
    ("cli",),
    ("__main__",),
)
# Leaves: what each may know of the package.
LEAVES = {
    "config": {"errors", "config"},
    "pytree": set(),
    "sinkhorn": {"config", "errors", "pytree"},
    "losses": {"config", "errors"},
    "scores": {"errors"},
    "data": {"config", "cores", "errors", "files", "data"},
}
CORE = (
    *("__init__", "config", "cores", "errors", "platform", "pytree"),
    *("sinkhorn", "losses", "model", "nn"),
)
CORE_NEEDS = {"jax", "numpy", "jaxtyping", "equinox", "optimistix"}


def part_of(module: str) -> str:
    """The name in LAYERS that a dotted module name belongs to."""
    return module.split(".")[1] if "." in module else "__init__"


def module_name(path: pathlib.Path) -> str:
    parts = path.relative_to(SOURCE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sorted(SOURCE.rglob("*.py"))}


def imports(module: str, *, at_load: bool = False) -> Iterator[str]:
    """Dotted names that a module imports: all, or only those that loading it runs."""

    def visit(node: ast.AST) -> Iterator[str]:
        if at_load and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            return
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            if not at_load:
                yield from (name for child in node.body for name in visit(child))
            return
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import, expected absolute ones"
            assert node.module is not None
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in MODULES else node.module
        for child in ast.iter_child_nodes(node):
            yield from visit(child)

    return visit(ast.parse(MODULES[module].read_text(encoding="utf-8")))


def test_the_walk_sees_what_it_should():
    """Against a source whose imports are known: the other tests pass on an empty walk."""
    assert {PACKAGE, f"{PACKAGE}.nn.vit", f"{PACKAGE}.data.images"} <= MODULES.keys()
    assert {"cv2", "numpy", f"{PACKAGE}.errors"} <= set(imports(f"{PACKAGE}.data.images"))
    assert f"{PACKAGE}.checkpoint" in set(imports(PACKAGE))
    assert set(imports(PACKAGE, at_load=True)) == {"importlib", "typing"}


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_one_way(module: str):
    layer_of = {name: number for number, names in enumerate(LAYERS) for name in names}
    part = part_of(module)
    if part == "__init__":  # the public face names all, and loads none (see below)
        return
    for name in imports(module):
        if name.split(".")[0] != PACKAGE:
            continue
        found = part_of(name)
        allowed = layer_of[found] < layer_of[part] or (found == part and module != name)
        assert allowed, f"{module} imports {name}, expected only what stands before it in LAYERS"
        if part in LEAVES:
            assert found in LEAVES[part], f"{module}, a leaf, imports {name}"


@pytest.mark.parametrize("module", MODULES)
def test_foreign_imports_stay_where_they_belong(module: str):
    part = part_of(module)
    everywhere = {name.split(".")[0] for name in imports(module)}
    # Reading a torch file is the one thing that takes torch, and only when it is asked for.
    assert "torch" not in everywhere or part == "convert", f"{module} imports torch"
    assert "torch" not in {name.split(".")[0] for name in imports(module, at_load=True)}
    if part == "data":
        assert "jax" not in everywhere, f"{module} imports jax"
    if part in CORE:
        loads = {name.split(".")[0] for name in imports(module, at_load=True)}
        foreign = loads - CORE_NEEDS - set(sys.stdlib_module_names) - {PACKAGE}
        assert not foreign, f"{module}, of the light core, loads {foreign}"


def loaded_after(statement: str, candidates: set[str]) -> set[str]:
    """Which of the top-level modules a fresh interpreter has loaded after a statement."""
    program = f"import sys\n{statement}\nprint(*sorted({candidates!r} & sys.modules.keys()))"
    done = subprocess.run(
        [sys.executable, "-c", program],
        check=True,
        capture_output=True,
        text=True,
        cwd=SOURCE.parent,
    )
    return set(done.stdout.split())


HEAVY = {
    *("cv2", "grain", "h5py", "matplotlib", "numba", "optax", "orbax", "rich", "safetensors"),
    "tyro",
}


def test_a_model_needs_no_file_formats():
    statement = f"import {PACKAGE}; import {PACKAGE}.model; {PACKAGE}.describe, {PACKAGE}.recipe"
    assert loaded_after(statement, HEAVY | {"torch", "jax"}) == {"jax"}


def test_what_describes_starts_without_what_trains():
    loaded = loaded_after(f"import {PACKAGE}.cli", HEAVY)
    assert {"tyro", "cv2", "safetensors"} <= loaded
    assert not loaded & {"optax", "matplotlib"}


def test_pictures_need_no_jax():
    statement = f"import {PACKAGE}.data.images, {PACKAGE}.data.places, {PACKAGE}.data.benchmarks"
    assert loaded_after(statement, {"jax", "torch", "cv2", "scipy"}) == {"cv2"}
