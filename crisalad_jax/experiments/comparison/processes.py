"""Several processes of this host that share its devices and the runs of a comparison."""

import contextlib
import functools
import multiprocessing
import os
import signal
import threading
import warnings
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, NamedTuple

import jax

from crisalad_jax.config.plugins import load_entry_points, load_plugin, loaded_plugins
from crisalad_jax.utils.errors import InputError, Interrupted
from crisalad_jax.utils.output import Note, warn
from crisalad_jax.utils.signals import defer_signals

_MEMORY = 0.9
"""Share of a GPU's memory that all processes on it may take together."""
_JAX = (
    *("jax_platforms", "jax_num_cpu_devices", "jax_compilation_cache_dir"),
    "jax_persistent_cache_min_compile_time_secs",
)
"""Settings of JAX that a process has as its parent, so that a run has the same bits."""


class Share(NamedTuple):
    """What a process gets of the host's devices."""

    environment: Mapping[str, str]
    beside: bool
    """Whether others use them too."""


def run_jobs(work: Callable[..., Any], jobs: int, say: Callable[[str], None]) -> None:
    """Let processes share work, each with some of the devices; this one uses none meanwhile.

    A process that is killed leaves its work to the others. A signal ends all of them, with their
    work saved. A program that calls this needs `if __name__ == "__main__"`.

    Args:
        work: called in each process with `say`, and `beside`: whether others use its devices.
        jobs: number of processes.
        say: is given what they say, with their numbers from 1.

    Raises:
        InputError: what any of them raises as one; the others are ended.
        Interrupted: a signal asked for the end; the same call resumes.
    """
    spawn = multiprocessing.get_context("spawn")  # a fork of a process that uses JAX can deadlock
    settings = {name: getattr(jax.config, name) for name in _JAX}
    with ProcessPoolExecutor(1, spawn) as asked:
        # JAX takes most of a GPU's memory in the process that asks.
        platform, count = asked.submit(_devices, settings).result()
    shares = shares_of(platform, count, jobs, os.environ.get("CUDA_VISIBLE_DEVICES"))
    processes: dict[Connection, SpawnProcess] = {}
    with defer_signals() as stop:
        stop.has_work = True  # of the processes, which this one ends
        try:
            for number, share in enumerate(shares, 1):
                reader, writer = spawn.Pipe(duplex=False)
                arguments = (work, share, settings, loaded_plugins(), writer)
                process = spawn.Process(target=_run, args=arguments, name=str(number))
                process.start()
                writer.close()
                processes[reader] = process
            _pass_on(processes, stop.check, say)
        finally:  # after an error they save their work; a second signal does not wait for it
            for process in processes.values():
                process.terminate()
            for process in processes.values():
                process.join()


def shares_of(platform: str, count: int, jobs: int, visible: str | None) -> list[Share]:
    """Share a host's devices between processes.

    GPUs are dealt out, one or more to each process. Where there are too few, processes share one,
    and its memory. On a CPU all use all cores.

    Args:
        platform: "cpu" or "gpu".
        count: number of devices.
        jobs: number of processes.
        visible: the value of CUDA_VISIBLE_DEVICES, if it is set.

    Returns:
        The share of each process.

    Raises:
        InputError: another platform.

    Example:
        >>> [share.environment for share in shares_of("gpu", 2, 2, "4,5")]
        [{'CUDA_VISIBLE_DEVICES': '4'}, {'CUDA_VISIBLE_DEVICES': '5'}]
    """
    if platform == "cpu":
        return [Share({}, beside=jobs > 1)] * jobs
    if platform != "gpu":
        raise InputError(
            f"--jobs: found {jobs} on {platform}, expected 1: one process takes all of its devices"
        )
    names = [str(number) for number in range(count)]
    if visible:
        names = [name.strip() for name in visible.split(",")][:count]
    shares = []
    for number in range(jobs):
        own = names[number::jobs] or [names[number % count]]
        users = len(range(number % count, jobs, count))
        environment = {"CUDA_VISIBLE_DEVICES": ",".join(own)}
        if jobs > count:
            environment["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{_MEMORY / users:.3f}"
        shares.append(Share(environment, beside=users > 1))
    return shares


def _set_up_jax(settings: Mapping[str, Any]) -> None:
    for name, value in settings.items():
        jax.config.update(name, value)


def _devices(settings: Mapping[str, Any]) -> tuple[str, int]:
    _set_up_jax(settings)
    return jax.default_backend(), jax.local_device_count()


def _pass_on(
    processes: Mapping[Connection, SpawnProcess],
    check: Callable[[], None],
    say: Callable[[str], None],
) -> None:
    """Pass on what the processes say until all have ended."""
    running, notes = dict(processes), set()
    while running:
        check()
        ready = wait(list(running), timeout=0.2)
        for reader in [each for each in running if each in ready]:
            process = running[reader]
            try:
                kind, text = reader.recv()
            except EOFError:
                process.join()
                del running[reader]
                if process.exitcode:
                    warn(
                        f"--jobs: found process {process.name} ended with code "
                        f"{process.exitcode}; its runs are left to the others"
                    )
                continue
            if kind == "error":
                raise InputError(text)
            if kind == "line":
                say(f"[{process.name}] {text}")
            elif text not in notes:
                notes.add(text)
                warn(text)


def _run(
    work: Callable[..., Any],
    share: Share,
    settings: Mapping[str, Any],
    plugins: Iterable[str],
    parent: Connection,
) -> None:
    """Do the work in a process, and send the parent what there is to say."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's is for the parent, which ends this
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.dup2(2, 1)  # what libraries and plug-ins print must not mix with the parent's output
    os.environ.update(share.environment)
    _set_up_jax(settings)

    def send(kind: str, text: object) -> None:
        with contextlib.suppress(BrokenPipeError):  # the parent was killed, which ends this too
            parent.send((kind, str(text)))

    warnings.showwarning = lambda message, *_, **__: send("note", message)
    warnings.simplefilter("always", Note)
    try:
        load_entry_points()
        for plugin in plugins:
            load_plugin(plugin)
        work(say=functools.partial(send, "line"), beside=share.beside)
    except InputError as error:
        send("error", error)
    except Interrupted:
        pass  # the parent has asked for it


def _end_with_parent() -> None:
    """End this process, its work saved, when the parent ends by whatever means."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)
