"""Several processes of one host that share the runs of a comparison."""

import json
import os
import pathlib
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax

from crisalad_jax.config.io import to_plain
from crisalad_jax.config.plugins import loaded_plugins
from crisalad_jax.data.loader import OnBadImage
from crisalad_jax.experiments.comparison.plan import ComparisonConfig
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.signals import defer_signals
from crisalad_jax.utils.target import absent_platforms

_MODULE = "crisalad_jax.experiments.comparison.worker"
_PROBE = "import jax; d = jax.local_devices(); print(d[0].platform, len(d))"
_MEMORY = 0.9
"""Share of a GPU's memory that all processes on it may take together."""


class Share(NamedTuple):
    """What a process gets of the host's devices."""

    environment: Mapping[str, str]
    beside: bool
    """Whether others use them too."""


def run_jobs(
    config: ComparisonConfig,
    out: pathlib.Path,
    jobs: int,
    *,
    on_bad_image: OnBadImage = "stop",
    say: Callable[[str], None],
) -> None:
    """Let processes do all runs of a comparison; this one uses no device meanwhile.

    A process that is killed leaves its run to the others. A signal ends all of them, with their
    work saved.

    Args:
        config: the comparison.
        out: its folder.
        jobs: number of processes.
        on_bad_image: "stop" at an unreadable image, or "skip" it.
        say: is given what they say, with their numbers from 1.

    Raises:
        InputError: what any of them raises as one; the others are ended.
        Interrupted: a signal asked for the end; the same call resumes.
    """
    shares = shares_of(*_devices(), jobs, os.environ.get("CUDA_VISIBLE_DEVICES"))
    task = {
        "config": to_plain(config),
        "out": str(out),
        "plugins": loaded_plugins(),
        "jobs": jobs,
        "on_bad_image": on_bad_image,
    }
    with defer_signals() as stop:
        stop.has_work = True  # of the processes, which this one ends
        workers: list[subprocess.Popen[bytes]] = []
        said: queue.Queue[tuple[int, dict[str, str] | None]] = queue.Queue()
        try:
            for number, share in enumerate(shares):
                worker = _started(share, task | {"beside": share.beside})
                workers.append(worker)
                threading.Thread(target=_listen, args=(number, worker, said), daemon=True).start()
            _pass_on(workers, said, stop.check, say)
        except BaseException:
            _end_all(workers)
            raise


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
    if platform not in ("gpu", "cuda", "rocm"):
        raise InputError(
            f"--jobs: found {jobs} on {platform}, expected 1: one process takes all of its devices"
        )
    names = [str(number) for number in range(count)]
    if visible:
        names = [name.strip() for name in visible.split(",")][:count]
    if jobs <= count:
        return [
            Share({"CUDA_VISIBLE_DEVICES": ",".join(names[number::jobs])}, beside=False)
            for number in range(jobs)
        ]
    users = [len(range(device, jobs, count)) for device in range(count)]
    return [
        Share(
            {
                "CUDA_VISIBLE_DEVICES": names[number % count],
                "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{_MEMORY / users[number % count]:.3f}",
            },
            beside=users[number % count] > 1,
        )
        for number in range(jobs)
    ]


def _devices() -> tuple[str, int]:
    """Find the platform and its number of devices, in a process of its own.

    JAX takes most of a GPU's memory as soon as it is asked.
    """
    if jax.config.jax_platforms == "cpu":  # pyright: ignore
        return "cpu", 1
    found = subprocess.run(
        [sys.executable, "-c", _PROBE],
        capture_output=True,
        text=True,
        check=False,
        env=_environment(),
    )
    words = found.stdout.split()
    if found.returncode or len(words) != 2:
        raise InputError(
            absent_platforms()
            or f"--jobs: found no devices, expected some: {found.stderr.strip().splitlines()[-1:]}"
        )
    return words[0], int(words[1])


def _environment() -> dict[str, str]:
    """Return an environment in which JAX is set up as here, so that a run has the same bits."""
    environment = dict(os.environ)
    environment["PYTHONPATH"] = os.pathsep.join(path or os.getcwd() for path in sys.path)
    if jax.config.jax_num_cpu_devices > 0:  # pyright: ignore
        environment["JAX_NUM_CPU_DEVICES"] = str(jax.config.jax_num_cpu_devices)  # pyright: ignore
    if jax.config.jax_compilation_cache_dir is not None:  # pyright: ignore
        environment["JAX_COMPILATION_CACHE_DIR"] = jax.config.jax_compilation_cache_dir  # pyright: ignore
    return environment


def _started(share: Share, task: Mapping[str, Any]) -> "subprocess.Popen[bytes]":
    worker = subprocess.Popen(
        [sys.executable, "-m", _MODULE],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=_environment() | dict(share.environment),
        # Ctrl-C comes to this process alone, which ends the others.
        start_new_session=True,
    )
    assert worker.stdin is not None
    try:
        worker.stdin.write(json.dumps(task).encode() + b"\n")
        worker.stdin.flush()
    except BrokenPipeError:
        pass  # it has ended, which is seen by its exit code
    return worker


def _listen(number: int, worker: "subprocess.Popen[bytes]", said: "queue.Queue[Any]") -> None:
    """Put what a process says into a queue, and None when it has ended."""
    assert worker.stdout is not None
    errors = threading.Thread(target=_forward, args=(worker,), daemon=True)
    errors.start()
    for line in worker.stdout:
        said.put((number, json.loads(line)))
    errors.join()
    worker.wait()
    said.put((number, None))


def _forward(worker: "subprocess.Popen[bytes]") -> None:
    """Show what a process prints for people, but not that this one ended it."""
    assert worker.stderr is not None
    for line in worker.stderr:
        if not line.startswith((b"crisalad: ended by", b"crisalad: interrupted")):
            sys.stderr.write(line.decode(errors="replace"))


def _pass_on(
    workers: Sequence["subprocess.Popen[bytes]"],
    said: "queue.Queue[tuple[int, dict[str, str] | None]]",
    check: Callable[[], None],
    say: Callable[[str], None],
) -> None:
    """Pass on what the processes say until all have ended."""
    running, notes = len(workers), set()
    while running:
        check()
        try:
            number, message = said.get(timeout=0.2)
        except queue.Empty:
            continue
        if message is None:
            running -= 1
            code = workers[number].returncode
            if code:
                others = "the others go on" if running else "what is left is done here"
                warn(f"--jobs: found process {number + 1} ended with code {code}; {others}")
        elif "error" in message:
            raise InputError(message["error"])
        elif "say" in message:
            say(f"[{number + 1}] {message['say']}")
        elif message["note"] not in notes:
            notes.add(message["note"])
            warn(message["note"])


def _end_all(workers: Sequence["subprocess.Popen[bytes]"]) -> None:
    """End processes after they saved their work; a second signal kills them."""
    for worker in workers:
        if worker.poll() is None:
            worker.send_signal(signal.SIGTERM)
    try:
        for worker in workers:
            worker.wait()
    except KeyboardInterrupt:
        for worker in workers:
            worker.kill()
        raise
