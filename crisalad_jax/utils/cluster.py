"""A Ray cluster: join or start it, check its nodes, and call a function on all of them.

This is the only module that connects to Ray.
"""

import collections
import contextlib
import heapq
import importlib.metadata
import logging
import os
import pathlib
import platform
import re
import signal
import socket
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

from crisalad_jax.utils.errors import InputError, few, locate_errors
from crisalad_jax.utils.extras import missing_extra
from crisalad_jax.utils.files import wrap_os_errors
from crisalad_jax.utils.host import usable_cores
from crisalad_jax.utils.output import Note, one_line, warn
from crisalad_jax.utils.version import VERSION

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_ADDRESS = re.compile(r"(ray://)?(\[[^\]]+\]|[^:/\s\[\]]+)(?::(\d{1,5}))?")
_CLIENT_PORT = 10001
_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",  # no telemetry
    "RAY_SCHEDULER_EVENTS": "0",  # nor the autoscaler's lines
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # nor a warning about this variable
}
CONNECT, ANSWER, START, RESULT = 60.0, 120.0, 300.0, 1800.0
"""Maximum seconds to wait: for a cluster, for its nodes' answers, for the first worker, and for any
worker's result."""
_REASON = 300
"""Maximum characters to quote from Ray's message about the end of a worker."""
_STARTS = -1
"""Used in place of an item's number while a worker is starting."""
_TRIES = 5
"""How many workers may end at the same item, or while they start, before this is an error."""


def check_cluster(address: str | None) -> tuple[str, int] | None:
    """Return the host and port of a cluster's address; None for None, "local" and "auto".

    Raises:
        InputError: `address` is none of these, nor ray://HOST[:PORT] or HOST:PORT.
    """
    if address in (None, "local", "auto"):
        return None
    found = _ADDRESS.fullmatch(address)
    if found is None or not (found[1] or found[3]):
        raise InputError(
            f"--cluster: got {address!r}, expected local, auto, ray://HOST[:PORT] or HOST:PORT"
        )
    return found[2].strip("[]"), int(found[3] or _CLIENT_PORT)


@contextlib.contextmanager
def connected(address: str) -> Iterator[Any]:
    """Join or start a Ray cluster for the block, and yield the module `ray`.

    Ray's own banners, logs and telemetry are off, and signals keep their handlers. If this process
    has already joined a cluster, that one is used, and stays connected.

    Args:
        address: "local" starts Ray on this machine and stops it afterwards; "auto" joins the
            cluster that this machine is a node of; ray://HOST[:PORT] joins as a client;
            HOST:PORT is the address of a cluster that this machine is a node of.

    Raises:
        InputError: `address` is invalid; Ray is not installed; the cluster does not exist,
            has another version of Ray or Python, or is lost during the block.
    """
    there = check_cluster(address)
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    what = f"--cluster {address}"
    try:
        import ray
        import ray.exceptions
    except ModuleNotFoundError as error:
        raise InputError(missing_extra(error, what)) from error
    joins = not ray.is_initialized()
    if there is not None and joins:
        _check_port(what, *there)
    try:
        if joins:
            _join(ray, address, what)
        yield ray
    except (ray.exceptions.RayError, ConnectionError) as error:
        raise InputError(f"{what}: {_reason(error)}") from error
    finally:
        if joins:
            _within(CONNECT, ray.shutdown)


def _check_port(what: str, host: str, port: int) -> None:
    """Check that something listens there: Ray itself would wait for minutes."""
    try:
        socket.create_connection((host, port), timeout=10).close()
    except OSError as error:
        raise InputError(
            f"{what}: cannot connect to {host} at port {port} ({error.strerror or error}), "
            "expected a Ray cluster (`ray start --head`)"
        ) from error


def _join(ray: Any, address: str, what: str) -> None:
    """Start or join the cluster, without its output."""
    # Ray reports the death of a worker on standard output, which may be JSON.
    ray._private.worker.print_to_stdstream = lambda *_, **__: None
    logging.getLogger("ray").setLevel(logging.CRITICAL)
    options = {"log_to_driver": False, "logging_level": logging.CRITICAL}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            if address == "local":
                # In this thread: the kernel ends Ray's processes with the thread that started them.
                before = signal.getsignal(signal.SIGTERM)
                ray.init("local", num_cpus=usable_cores(), include_dashboard=False, **options)
                if threading.current_thread() is threading.main_thread():
                    signal.signal(signal.SIGTERM, before)
                return
            joined = _within(CONNECT, lambda: ray.init(address, **options))
        except Exception as error:  # Ray raises many types
            raise InputError(f"{what}: cannot be joined: {_reason(error)}") from error
    if not joined:
        raise InputError(f"{what}: found no answer from a Ray cluster within {CONNECT:.0f} s")


def _reason(error: Exception) -> str:
    """Return Ray's message in one line, or the last line of a remote traceback."""
    lines = str(error).strip().splitlines()
    return one_line(lines[-1] if "Traceback" in str(error) else error)


def _within(seconds: float, work: Callable[[], Any]) -> bool:
    """Run a function in a thread, and return whether it ended in time; raise what it raises."""
    raised: list[Exception] = []

    def run() -> None:
        try:
            work()
        except Exception as error:
            raised.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(seconds)
    if raised:
        raise raised[0]
    return not thread.is_alive()


def check_nodes(ray: Any, *, read: Sequence[str] = (), write: pathlib.Path | None = None) -> None:
    """Check that every node has this package, and can read and write the same files.

    Args:
        ray: the module, from `connected`.
        read: absolute paths and addresses (s3://...) that nodes have to read.
        write: absolute path of an existing folder that they all have to share and write into.

    Raises:
        InputError: a node lacks the package or has another version of it, of Python or of JAX, or
            cannot read or write a path; or does not answer. The message names it.
    """
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    jax = importlib.metadata.version("jax")
    expected = {"Python": platform.python_version(), "crisalad-jax": VERSION, "jax": jax}
    with contextlib.ExitStack() as stack:
        mark = None
        if write is not None:
            stack.enter_context(wrap_os_errors(write))
            mark = stack.enter_context(tempfile.NamedTemporaryFile(dir=write)).name
        asked = {}
        for node in _nodes(ray):
            there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            look = ray.remote(_look_by_value()).options(num_cpus=0, scheduling_strategy=there)
            name = f"node {node['NodeManagerHostname']} ({node['NodeManagerAddress']})"
            asked[look.remote(expected, list(read), mark)] = name
        answered, late = ray.wait(list(asked), num_returns=len(asked), timeout=ANSWER)
        found = [(asked[each], ray.get(each)) for each in answered]
    problems = [f"{name}: {each}" for name, problems in found for each in problems]
    problems += [f"{asked[each]}: no answer within {ANSWER:.0f} s" for each in late]
    if problems:
        raise InputError(f"--cluster: {one_line(few(problems))}")


def _look_by_value() -> Callable[[Mapping[str, str], list[str], str | None], list[str]]:
    """Return the function that lists a node's problems; it runs on nodes that lack this package."""

    def look(expected: Mapping[str, str], paths: list[str], mark: str | None) -> list[str]:
        import importlib
        import importlib.metadata
        import os
        import platform
        import tempfile

        found = {"Python": platform.python_version()}
        try:
            found["crisalad-jax"] = importlib.import_module("crisalad_jax.utils.version").VERSION
            found["jax"] = importlib.metadata.version("jax")
        except Exception as error:  # it is missing, or cannot be imported
            return [f"cannot import crisalad_jax ({error}), expected {expected['crisalad-jax']}"]
        for what, version in found.items():
            if version != expected[what]:
                return [f"found {what} {version}, expected {expected[what]} as on this machine"]
        problems = []
        for path in paths:
            try:
                if "://" in path:
                    files, there = importlib.import_module("fsspec.core").url_to_fs(path)
                    files.cat_file(there, start=0, end=1)
                else:
                    os.listdir(path) if os.path.isdir(path) else open(path, "rb").close()
            except Exception as error:  # each file system raises its own
                reason = f"{type(error).__name__}: {error}"
                problems.append(f"cannot read {path}, as this machine can ({reason})")
        if mark is not None:
            try:
                os.stat(mark)  # a file of the driver's: the folder is the same one
                tempfile.TemporaryFile(dir=os.path.dirname(mark)).close()
            except OSError as error:
                folder = os.path.dirname(mark)
                problems.append(f"cannot write into {folder}, as this machine can ({error})")
        return problems

    return look


def _nodes(ray: Any) -> list[dict[str, Any]]:
    """List the nodes that are alive."""
    return [node for node in ray.nodes() if node["Alive"]]


def _slots(ray: Any) -> tuple[int, dict[str, float]]:
    """Return how many workers a cluster has room for, and the resources of each.

    A worker has a GPU; if no node has one, the CPUs of the smallest node.
    """
    all_of = [node["Resources"] for node in _nodes(ray) if node["Resources"].get("CPU", 0) >= 1]
    with_gpus = [each for each in all_of if each.get("GPU", 0) >= 1]
    if with_gpus:
        cores = min(each["CPU"] // each["GPU"] for each in with_gpus)
        return int(sum(each["GPU"] for each in with_gpus)), {"num_gpus": 1, "num_cpus": cores}
    cores = min((each["CPU"] for each in all_of), default=1)
    return int(sum(each["CPU"] // cores for each in all_of)), {"num_cpus": cores}


class _Worker:
    """An actor that calls a function in a process of a node, where it stays in memory."""

    def __init__(self, folder: str, environment: Mapping[str, str]) -> None:
        """Change to the folder that relative paths start from, if it exists, and set variables."""
        os.environ.update(environment)
        with contextlib.suppress(OSError):
            os.chdir(folder)

    def start(self, prepare: Callable[[], None], held: Sequence[Any]) -> None:
        """Prepare the process, and get the function from its reference."""
        import ray

        with locate_errors(f"node {socket.gethostname()}: "):
            prepare()
            self._work: Callable[[Any], Any] = ray.get(held[0])  # pyright: ignore

    def call(self, item: Any) -> tuple[Any, list[str]]:
        """Return the function's result, and its notes."""
        with locate_errors(f"node {socket.gethostname()}: "):
            return with_notes(self._work, item)


def with_notes(work: Callable[..., _Result], *given: Any) -> tuple[_Result, list[str]]:
    """Call a function; return its result and its `Note` warnings, for another process to show."""
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always", Note)
        result = work(*given)
    return result, [str(each.message) for each in notes if issubclass(each.category, Note)]


def map_in_order(
    ray: Any,
    work: Callable[[_Item], _Result],
    items: Sequence[_Item],
    *,
    prepare: Callable[[], None],
    environment: Mapping[str, str],
) -> Iterator[_Result]:
    """Yield the result of `work` for each item, in the order of the items.

    If a worker is lost, its item goes to another, and a new worker is started where there is room.
    Only a few items are started ahead of the next one to yield.

    Args:
        ray: the module, from `connected`.
        work: a function that can be pickled.
        items: what to work on.
        prepare: called in each process before `work` is unpickled.
        environment: environment variables that are set in each process before `prepare`.

    Raises:
        InputError: `work` raises one (the node's name is added); workers end repeatedly; no worker
            starts within `START` seconds; or none has a result within `RESULT` seconds.
    """
    count, resources = _slots(ray)
    remote = ray.remote(_Worker).options(**resources, scheduling_strategy="SPREAD")
    held = ray.put(work)
    idle: list[Any] = []
    busy: dict[Any, tuple[Any, int]] = {}
    waiting, done, ends = list(range(len(items))), {}, collections.Counter[int]()

    def start() -> None:
        worker = remote.remote(os.getcwd(), environment)
        busy[worker.start.remote(prepare, [held])] = worker, _STARTS

    try:
        for _ in range(min(count, len(items))):
            start()
        for number in range(len(items)):
            while number not in done:
                while idle and waiting and waiting[0] < number + 2 * count:
                    worker, item = idle.pop(), heapq.heappop(waiting)
                    busy[worker.call.remote(items[item])] = worker, item
                limit = START if all(item == _STARTS for _, item in busy.values()) else RESULT
                ready, _ = ray.wait(list(busy), timeout=limit)
                if not ready:
                    raise InputError(
                        f"--cluster: no worker with {resources} has started, or finished its work, "
                        f"in {limit:.0f} s, expected a free node"
                    )
                worker, item = busy.pop(ready[0])
                try:
                    found = ray.get(ready[0], timeout=ANSWER)
                except ray.exceptions.RayTaskError as error:
                    raise getattr(error, "cause", error) from None
                except ray.exceptions.RayError as error:
                    ray.kill(worker)  # it may only be out of reach
                    ends[item] += 1
                    if ends[item] == _TRIES:
                        raise InputError(
                            f"--cluster: workers ended {_TRIES} times at the same work: "
                            f"{one_line(error)[:_REASON]}"
                        ) from error
                    if item != _STARTS:
                        heapq.heappush(waiting, item)
                    start()
                    continue
                idle.append(worker)
                if item == _STARTS:
                    ends[item] = 0
                    continue
                done[item], notes = found
                for note in notes:
                    warn(note)
            yield done.pop(number)
    finally:
        for worker in [*idle, *(worker for worker, _ in busy.values())]:
            ray.kill(worker)
