"""Plug-ins: files or modules that register parts when they are imported."""

import hashlib
import importlib
import importlib.util
import os
import pathlib
import sys
import traceback
from collections.abc import Callable
from types import ModuleType

from crisalad_jax.config.checks import takes
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import real_path

ENTRY_POINTS = "crisalad_jax.plugins"
"""Group of entry points under which an installed package names its modules of parts."""
_FILES: dict[str, pathlib.Path] = {}
"""File of each loaded plug-in, by its module's name."""
_ENTERED: set[str] = set()
_PLUGINS: dict[str, None] = {}
"""What `load_plugin` loaded, in that order; of a file its whole path."""
_LOADED: set[str] = set()
"""Source files of all loaded plug-ins."""


@takes(plugin=str)
def load_plugin(plugin: str) -> None:
    r"""Import a plug-in, once, so that its parts are registered.

    Its code runs: load what you trust.

    Args:
        plugin: a file FILE.py, or the name of a module that can be imported.

    Raises:
        InputError: there is no such file or module, or it raises.

    Example:
        >>> lines = [
        ...     "import crisalad_jax as cj",
        ...     "@cj.register_aggregator('patch-mean')",
        ...     "def patch_mean(features):",
        ...     "    return features.patches.mean(axis=0)",
        ... ]
        >>> _ = (folder / "mean.py").write_text("\n".join(lines))
        >>> load_plugin(str(folder / "mean.py"))
        >>> from crisalad_jax import CrossImageConfig, ModelConfig
        >>> alone = CrossImageConfig(layers=0)
        >>> ModelConfig(aggregator="patch-mean", cross_image=alone).descriptor_dim
        768
    """
    try:
        if plugin.endswith(".py"):
            _load_file(plugin)
        else:
            _load_module(plugin)
    except InputError as error:
        raise InputError(f"plugin {plugin}: {error}") from error
    _PLUGINS[str(real_path(pathlib.Path(plugin))) if plugin.endswith(".py") else plugin] = None


def has_plugins() -> bool:
    """Return whether code of any plug-in was loaded, of a file, a module or an entry point."""
    return bool(_LOADED or _ENTERED)


def loaded_plugins() -> list[str]:
    """Return what `load_plugin` takes to load the same in another process."""
    return list(_PLUGINS)


_LARGEST = 2**24
"""Most bytes of a plug-in's file: Python reads and copies it whole."""


def _load_module(name: str) -> None:
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        spec = None
    if spec is None or spec.origin is None:  # a folder without __init__.py has no origin
        raise InputError("found no such module, expected FILE.py or MODULE")
    _run(lambda: importlib.import_module(name), spec.origin)


def _load_file(file: str) -> None:
    path = pathlib.Path(file)
    if not path.is_file():
        raise InputError("found no such file, expected FILE.py or MODULE")
    if (size := path.stat().st_size) > _LARGEST:
        raise InputError(f"found {size} bytes, expected a file of Python, of at most {_LARGEST}")
    path = real_path(path)
    # Give files of the same name different modules.
    name = f"crisalad_plugin_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module, loader = importlib.util.module_from_spec(spec), spec.loader
    sys.modules[name], _FILES[name] = module, path

    def run() -> ModuleType:
        loader.exec_module(module)
        return module

    try:
        _run(run, str(path))
    except BaseException:
        del sys.modules[name], _FILES[name]
        raise


def _run(load: Callable[[], ModuleType], file: str) -> None:
    """Run a plug-in's import, and report in one line what it raises, and where."""
    try:
        load()
        _LOADED.add(file)
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == file]
        if isinstance(error, SyntaxError):
            lines.append(error.lineno)
        where = f" in line {lines[-1]}" if lines else ""
        what = " ".join(str(error).split())
        if "non-frozen dataclass" in what:  # a part's, before it is registered
            raise InputError(
                f"found a part that is no frozen dataclass{where}, expected "
                "@dataclasses.dataclass(frozen=True)"
            ) from error
        raise InputError(
            f"cannot be loaded: it raises {type(error).__name__}{where}: {what}"
        ) from error


def plugin_failure(error: BaseException) -> str | None:
    """Describe in one line an exception that plug-ins may have caused; None without plug-ins.

    If it came from a plug-in's code, the line says where. Else a plug-in may have returned what
    nothing here can work with, so the line names all plug-ins. `SystemExit` must be a plug-in's.
    """
    places = [
        (place.filename, place.lineno, place.name)
        for place in traceback.extract_tb(error.__traceback__)
        if place.filename in _LOADED
    ]
    if not _LOADED or (not places and isinstance(error, SystemExit)):
        return None
    where = ", ".join(sorted(_LOADED))
    if places:
        file, line, function = places[-1]
        where = f"{file}: line {line}, in {function}"
    return f"plugin {where}: {type(error).__name__}: {' '.join(str(error).split())}"


def plugin_of(module: str) -> str | None:
    """Return the plug-in file that a module was loaded from; None for other modules."""
    path = _FILES.get(module)
    return None if path is None else str(path)


def home_of(module: str | None) -> str | None:
    """Return what `--plugin` takes to load a part's module: a file's name, or the module.

    Files record it: no folder, so that a copy on another machine is the same. None for modules of
    this package, and where there is no file or no module, as in a notebook or in `exec`.
    """
    if module is None or module.partition(".")[0] == __name__.partition(".")[0]:
        return None
    file = plugin_of(module)
    if module == "__main__":
        file = getattr(sys.modules[module], "__file__", None)
        return file and os.path.basename(file)
    return os.path.basename(file) if file else module


def load_entry_points() -> None:
    """Import the modules that installed packages name under `ENTRY_POINTS`, each once.

    Raises:
        InputError: what `load_plugin` raises.
    """
    import importlib.metadata  # a fifth of the time of `crisalad --help`

    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS):
        if entry.module not in _ENTERED:
            _ENTERED.add(entry.module)
            load_plugin(entry.module)
