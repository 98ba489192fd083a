"""Plug-ins: files or modules that register parts when they are imported."""

import functools
import hashlib
import importlib
import importlib.util
import os
import pathlib
import sys
import traceback
from collections.abc import Iterable, Mapping
from importlib.machinery import ModuleSpec
from typing import Any

from crisalad_jax.config.checks import takes
from crisalad_jax.config.part import Part, parts_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import real_path
from crisalad_jax.utils.output import one_line

ENTRY_POINTS = "crisalad_jax.plugins"
"""Group of entry points under which an installed package names its plug-in modules."""
_PACKAGE = __name__.partition(".")[0]
_FROM_FILE = "crisalad_plugin_"
"""Prefix of the names of modules that are loaded from plug-in files."""
_LARGEST = 2**24
"""Maximum bytes of a plug-in file: Python reads and copies all of it."""
_LOADED: dict[str, str] = {}
"""What `load_plugin` loaded, in order (for a file, its absolute path), and the module's name."""


@takes(plugin=str)
def load_plugin(plugin: str) -> None:
    r"""Import a plug-in, once, so that its parts are registered.

    Its code is run: load only what you trust.

    Args:
        plugin: a file FILE.py, or the name of a module that can be imported.

    Raises:
        InputError: there is no such file or module, or importing it raises an exception.

    Example:
        >>> lines = [
        ...     "import crisalad_jax as cj",
        ...     "@cj.register_aggregator('patch-mean')",
        ...     "def patch_mean(features):",
        ...     "    return features.patches.mean(axis=0)",
        ... ]
        >>> _ = (folder / "mean.py").write_text("\n".join(lines))
        >>> load_plugin(str(folder / "mean.py"))
        >>> from crisalad_jax import ModelConfig
        >>> ModelConfig(aggregator="patch-mean", cross_image="none").descriptor_dim
        768
    """
    spec = _spec_of(plugin)
    if spec is None or spec.origin is None:  # a folder without __init__.py has no origin
        kind = "file" if plugin.endswith(".py") else "module"
        raise InputError(f"plugin {plugin}: found no such {kind}, expected FILE.py or MODULE")
    try:
        _import(spec)
    except InputError as error:
        raise InputError(f"plugin {plugin}: {error}") from error
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        lines = [frame.lineno for frame in frames if frame.filename == spec.origin]
        if isinstance(error, SyntaxError) and error.lineno is not None:
            lines.append(error.lineno)
        where = f" in line {lines[-1]}" if lines else ""
        raise InputError(
            f"plugin {plugin}: cannot be loaded: it raises {type(error).__name__}{where}: "
            f"{one_line(error)}"
        ) from error
    _LOADED[spec.origin if plugin.endswith(".py") else plugin] = spec.name


def loaded_plugins() -> list[str]:
    """Return the plug-ins loaded so far, for `load_plugins` in another process."""
    return list(_LOADED)


def load_plugins(plugins: Iterable[str]) -> None:
    """Load the plug-ins of installed packages, then `plugins`, each as `load_plugin` does."""
    load_entry_points()
    for plugin in plugins:
        load_plugin(plugin)


def _spec_of(plugin: str) -> ModuleSpec | None:
    """Find the code of a plug-in; None if there is none."""
    if not plugin.endswith(".py"):
        try:
            return importlib.util.find_spec(plugin)
        except (ImportError, ValueError):
            return None
    path = real_path(plugin)
    if not path.is_file():
        return None
    if (size := path.stat().st_size) > _LARGEST:
        raise InputError(
            f"plugin {plugin}: found {size} bytes, expected a Python file of at most {_LARGEST}"
        )
    # Files of the same name are different modules.
    name = f"{_FROM_FILE}{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    return importlib.util.spec_from_file_location(name, path)


def _import(spec: ModuleSpec) -> None:
    """Import a module, once."""
    if not spec.name.startswith(_FROM_FILE):
        importlib.import_module(spec.name)
    elif spec.name not in sys.modules:
        module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
        assert spec.loader is not None
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[spec.name]
            raise


def plugin_failure(error: BaseException) -> str | None:
    """Describe an exception that a plug-in may have caused, in one line; None without plug-ins.

    If a plug-in's code raised it, the line says where. Otherwise a plug-in may have returned
    something unusable, so the line names all plug-ins; for a SystemExit the result is then None.
    """
    files = {str(sys.modules[name].__file__) for name in _LOADED.values()}
    places = [p for p in traceback.extract_tb(error.__traceback__) if p.filename in files]
    if not files or (not places and isinstance(error, SystemExit)):
        return None
    where = ", ".join(sorted(files))
    if places:
        where = f"{places[-1].filename}: line {places[-1].lineno}, in {places[-1].name}"
    return f"plugin {where}: {type(error).__name__}: {one_line(error)}"


def home_of(module: str | None) -> str | None:
    """Return what `--plugin` takes to load a part's module: a file's name, or the module.

    Weight files record it. It has no folder, so that it is the same on another machine. It is None
    for modules of this package, and without a file or a module, as in a notebook or in `exec`.
    """
    if module is None or module.partition(".")[0] == _PACKAGE:
        return None
    if module == "__main__" or module.startswith(_FROM_FILE):
        file = getattr(sys.modules[module], "__file__", None)
        return file and os.path.basename(file)
    return module


@functools.cache
def load_entry_points() -> None:
    """Import the modules that installed packages name under `ENTRY_POINTS`, once.

    Raises:
        InputError: a module is missing, or importing it raises an exception.
    """
    import importlib.metadata  # a fifth of the time of `crisalad --help`

    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS):
        load_plugin(entry.module)


def source_digest(part: type[Part]) -> str | None:
    """Compute the SHA-256 of the file that defines a part of a plug-in.

    Return None if there is no such file, or for parts of this package (its version is enough).
    """
    file = getattr(sys.modules.get(part.__module__), "__file__", None)
    if part.__module__.partition(".")[0] == _PACKAGE or file is None:
        return None
    return hashlib.sha256(pathlib.Path(file).read_bytes()).hexdigest()


def sources_of(config: Any) -> dict[str, tuple[str, str | None]]:
    """Return (name, `source_digest`) of every part in a configuration, by dotted field name."""
    return {
        field: (part.part_name, source_digest(type(part)))
        for field, part in parts_of(config).items()
    }


def changed_sources(config: Any, recorded: Mapping[str, Any]) -> list[str]:
    """List the parts, as "FIELD NAME", whose source has changed since `sources_of` recorded it."""
    changed = []
    for field, (name, digest) in sources_of(config).items():
        recorded_name, before = recorded.get(field, (None, None))
        if name == recorded_name and digest and before and digest != before:
            changed.append(f"{field} {name}")
    return changed
