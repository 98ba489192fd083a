"""A Ray cluster: join or start it, check its nodes, and call a function on all of them.

This is the only module that knows how to reach Ray.
"""

import collections
import contextlib
import heapq
import logging
import os
import pathlib
import re
import signal
import socket
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from crisalad_jax.utils.errors import InputError, few
from crisalad_jax.utils.extras import missing_extra
from crisalad_jax.utils.files import wrap_os_errors
from crisalad_jax.utils.host import usable_cores
from crisalad_jax.utils.output import Note, one_line, warn

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_ADDRESS = re.compile(r"(ray://)?(\[[^\]]+\]|[^:/\s\[\]]+)(?::(\d{1,5}))?")
_CLIENT_PORT = 10001
_QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",  # no telemetry
    "RAY_SCHEDULER_EVENTS": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
}
CONNECT, ANSWER, START, PIECE = 60.0, 120.0, 300.0, 1800.0
"""Seconds to wait at most: for a cluster, for its nodes' answers, for the first worker, and for any
worker to finish a piece of work."""
_QUEUED = 2
"""Pieces that a worker has at a time, one of them waiting."""
_REASON = 300
"""Letters of what Ray says of a worker's end."""
_TRIES = 5
"""Times that a piece, or the start of a worker, may end with its worker's death."""


def check_cluster(address: str | None) -> tuple[str, int] | None:
    """Return host and port of a cluster's address; None for None, "local" and "auto".

    Raises:
        InputError: it is not an address.
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
def connected(address: str, *, cores: int | None = None) -> Iterator[Any]:
    """Join or start a Ray cluster for the block, and yield the module `ray`.

    Ray's own banners, logs and telemetry are off, and signals keep their handlers. If this process
    has joined a cluster already, that one is used, and stays.

    Args:
        address: "local" starts Ray on this machine and ends it afterwards; "auto" joins the
            cluster that this machine is a node of; ray://HOST[:PORT] joins as a client;
            HOST:PORT is the address of a cluster that this machine is a node of.
        cores: number of CPUs that a local cluster offers; None is all that this process may use.

    Raises:
        InputError: not an address; Ray is not installed; there is no such cluster; it has another
            version of Ray or Python; or it is lost during the block.
    """
    there = check_cluster(address)
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    what = f"--cluster {address}"
    try:
        import ray
        import ray.exceptions
    except ModuleNotFoundError as error:
        raise InputError(missing_extra(error, what)) from error
    if there is not None and not ray.is_initialized():
        _check_port(what, *there)
    joins = not ray.is_initialized()
    try:
        if joins:
            _join(ray, address, what, cores)
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


def _join(ray: Any, address: str, what: str, cores: int | None) -> None:
    """Start or join the cluster, without its output."""
    # What Ray prints of the death of a worker goes to standard output, which may be JSON.
    ray._private.worker.print_to_stdstream = lambda *_, **__: None
    logging.getLogger("ray").setLevel(logging.CRITICAL)
    options = {"log_to_driver": False, "logging_level": logging.CRITICAL}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            if address == "local":
                # In this thread: the kernel ends Ray's processes with the one that started them.
                before = signal.getsignal(signal.SIGTERM)
                count = cores or usable_cores()
                ray.init("local", num_cpus=count, include_dashboard=False, **options)
                if threading.current_thread() is threading.main_thread():
                    signal.signal(signal.SIGTERM, before)
                return
            joined = _within(CONNECT, lambda: ray.init(address, **options))
        except Exception as error:  # Ray raises many
            raise InputError(f"{what}: cannot be joined: {_reason(error)}") from error
    if not joined:
        raise InputError(f"{what}: found no answer of a Ray cluster within {CONNECT:.0f} s")


def _reason(error: Exception) -> str:
    """Say in one line what Ray says, or the last line of a remote traceback."""
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
    """Check that every node has this package, and the files that this machine has.

    Args:
        ray: of `connected`.
        read: absolute paths and addresses (s3://...) that nodes have to read.
        write: absolute path of an existing folder that they all have to share and write into.

    Raises:
        InputError: a node lacks the package or has another version of it, of Python or of JAX, or
            cannot read or write a path; or does not answer. The message names it.
    """
    with contextlib.ExitStack() as stack:
        mark = None
        if write is not None:
            stack.enter_context(wrap_os_errors(write))
            mark = stack.enter_context(tempfile.NamedTemporaryFile(dir=write)).name
        look = _look_by_value()
        here, _ = look((), None)
        asked = {
            ray.remote(look).options(**_on(node, num_cpus=0)).remote(tuple(read), mark): node
            for node in _nodes(ray)
        }
        answered, silent = ray.wait(list(asked), num_returns=len(asked), timeout=ANSWER)
        problems = [f"{_name(asked[each])}: no answer within {ANSWER:.0f} s" for each in silent]
        for each in answered:
            versions, failed = ray.get(each)
            problems += [
                f"{_name(asked[each])}: {problem}"
                for problem in (
                    *(
                        f"found {what} {versions[what] or 'missing'}, expected {value} as here"
                        for what, value in here.items()
                        if versions[what] != value
                    ),
                    *(f"{one_line(each)}, but this machine can" for each in failed),
                )
            ]
    if problems:
        raise InputError(f"--cluster: {few(problems)}")


def _look_by_value() -> Callable[[Sequence[str], str | None], tuple[dict[str, str], list[str]]]:
    """Return a function that Ray sends whole, as nodes may lack this package."""

    def look(paths: Sequence[str], mark: str | None) -> tuple[dict[str, str], list[str]]:
        import importlib
        import importlib.metadata
        import os
        import platform
        import tempfile

        versions = {"Python": platform.python_version(), "crisalad-jax": "", "jax": ""}
        problems = []
        try:
            module = importlib.import_module("crisalad_jax.utils.version")
            versions["crisalad-jax"] = module.VERSION
            versions["jax"] = importlib.metadata.version("jax")
        except Exception:  # it is missing, or cannot be imported
            return versions, problems
        for path in paths:
            try:
                if "://" in path:
                    files, there = importlib.import_module("fsspec.core").url_to_fs(path)
                    files.cat_file(there, start=0, end=1)
                elif os.path.isdir(path):
                    os.listdir(path)
                else:
                    open(path, "rb").close()
            except Exception as error:  # each file system has its own
                problems.append(f"cannot read {path} ({type(error).__name__}: {error})")
        if mark is not None:
            folder = os.path.dirname(mark)
            try:
                os.stat(mark)  # a file of the driver's: the folder is the same one
                tempfile.TemporaryFile(dir=folder).close()
            except OSError as error:
                problems.append(f"cannot write into {folder} ({error.strerror})")
        return versions, problems

    return look


def _nodes(ray: Any) -> list[dict[str, Any]]:
    """List the nodes that are alive."""
    return [node for node in ray.nodes() if node["Alive"]]


def _name(node: dict[str, Any]) -> str:
    return f"node {node['NodeManagerHostname']} ({node['NodeManagerAddress']})"


def _on(node: dict[str, Any], **options: Any) -> dict[str, Any]:
    """Return the options of a task or an actor that runs on this node, or not at all."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    strategy = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
    return {**options, "scheduling_strategy": strategy}


class _Actor:
    """What calls a function in a process of a node."""

    def __init__(self, folder: str, environment: Mapping[str, str]) -> None:
        """Take the folder of relative paths, if it exists here, and variables."""
        os.environ.update(environment)
        with contextlib.suppress(OSError):
            os.chdir(folder)

    def start(self, prepare: Callable[[], None], held: Sequence[Any]) -> None:
        """Prepare the process, and take the function, to which there is a reference."""
        import ray

        prepare()
        self._work: Callable[[Any], Any] = ray.get(held[0])  # pyright: ignore

    def call(self, item: Any) -> tuple[list[str], Any]:
        """Return the notes that the function gives, and its result."""
        with warnings.catch_warnings(record=True) as notes:
            warnings.simplefilter("always", Note)
            result = self._work(item)
        return [str(each.message) for each in notes if issubclass(each.category, Note)], result


class _Place(NamedTuple):
    """Where a worker runs: with a GPU of a node, or with a node's CPUs."""

    node: dict[str, Any]
    resources: dict[str, float]


def _places(ray: Any) -> list[_Place]:
    """List a place for each GPU of all nodes; without GPUs, one for each node that has CPUs."""
    nodes = [node for node in _nodes(ray) if node["Resources"].get("CPU", 0) >= 1]
    with_gpus = [node for node in nodes if node["Resources"].get("GPU", 0) >= 1]
    places = []
    for node in with_gpus or nodes:
        has = node["Resources"]
        count = int(has["GPU"]) if with_gpus else 1
        resources = {"num_cpus": max(1, int(has["CPU"] / count)), "num_gpus": bool(with_gpus)}
        places += [_Place(node, resources)] * count
    return places


class _How(NamedTuple):
    """What a worker's process needs to begin."""

    environment: Mapping[str, str]
    prepare: Callable[[], None]
    held: Any
    """A reference to the function that it calls."""


class _Worker:
    """An actor in its place, with the items that it has."""

    def __init__(self, ray: Any, place: _Place, how: _How, starts: int) -> None:
        """Start it: the reference `started` is ready once it can work."""
        actor = ray.remote(_Actor).options(**_on(place.node, **place.resources))
        self.place, self.actor = place, actor.remote(os.getcwd(), how.environment)
        self.started: Any = self.actor.start.remote(how.prepare, [how.held])
        self.starts = starts
        """How often one was started here since the last that worked."""
        self.is_ready = False
        self.items: list[int] = []

    def __str__(self) -> str:
        """Return the name of its node."""
        return _name(self.place.node)


def map_in_order(
    ray: Any,
    work: Callable[[_Item], _Result],
    items: Sequence[_Item],
    *,
    prepare: Callable[[], None],
    environment: Mapping[str, str],
) -> Iterator[_Result]:
    """Yield the result of `work` for each item, in the order of the items.

    A worker is a process for a GPU; where no node has one, for a node. The items of a worker that
    is lost are given to others. The few results that wait for their turn are in Ray's object store.

    Args:
        ray: of `connected`.
        work: a function that pickle can send.
        items: what to work on.
        prepare: called in each process before `work` is unpickled.
        environment: variables that are set in each process before that.

    Raises:
        InputError: what `work` raises as one, with the node's name; no worker can be started, or
            they end again and again; or none has finished an item within `PIECE` seconds.
    """
    pool = _Pool(ray, _How(environment, prepare, ray.put(work)), items)
    try:
        for number in range(len(items)):
            yield pool.result(number)
    finally:
        for worker in pool.workers:
            ray.kill(worker.actor)


class _Pool:
    """Workers that share items."""

    def __init__(self, ray: Any, how: _How, items: Sequence[Any]) -> None:
        """Start a worker in each place."""
        self._ray, self._how, self._items = ray, how, items
        self.workers = [_Worker(ray, place, how, 1) for place in _places(ray)]
        self._most = 2 * _QUEUED * len(self.workers)
        """Number of items that are begun before the first of them is asked for."""
        self._waiting = list(range(len(items)))
        """A heap of the items that no worker has."""
        self._losses = collections.Counter[int]()
        """How often the worker of an item has ended."""
        self._running: dict[Any, tuple[_Worker, int, Any]] = {}
        """A worker, its item and the reference to the result, by the reference to its notes."""
        self._done: dict[int, Any] = {}
        """References to the results that wait for their turn."""

    def result(self, number: int) -> Any:
        """Return the result of an item, once it is there; those before it have been asked for."""
        while True:
            while number not in self._done:
                self._hand_out(number + self._most)
                self._wait()
            try:
                return self._ray.get(self._done.pop(number), timeout=ANSWER)
            except self._ray.exceptions.GetTimeoutError:
                raise
            except self._ray.exceptions.RayError:  # it was lost with its node
                heapq.heappush(self._waiting, number)

    def _hand_out(self, end: int) -> None:
        """Give items before `end` to workers that have few."""
        for count in range(_QUEUED):
            for worker in self.workers:
                if not (self._waiting and self._waiting[0] < end):
                    return
                if worker.is_ready and len(worker.items) <= count:
                    number = heapq.heappop(self._waiting)
                    call = worker.actor.call.options(num_returns=2)
                    notes, result = call.remote(self._items[number])
                    worker.items.append(number)
                    self._running[notes] = worker, number, result

    def _wait(self) -> None:
        """Wait until a worker has started, finished an item, or ended."""
        starting = {worker.started: worker for worker in self.workers if not worker.is_ready}
        limit = PIECE if self._running else START
        ready, late = self._ray.wait([*self._running, *starting], timeout=limit)
        if not ready:
            names = {str(starting.get(each) or self._running[each][0]) for each in late}
            what = "finished an item of work" if self._running else "started (are its CPUs in use?)"
            raise InputError(
                f"--cluster: no worker has {what} in {limit:.0f} s: {few(list(names))}"
            )
        for reference in ready:
            worker = starting.get(reference)
            number = result = None
            if worker is None:
                worker, number, result = self._running.pop(reference)
            try:
                notes = self._ray.get(reference, timeout=ANSWER)
            except self._ray.exceptions.RayTaskError as error:
                cause = getattr(error, "cause", error)
                if isinstance(cause, InputError):
                    raise InputError(f"{worker}: {cause}") from error
                raise cause from None
            except self._ray.exceptions.RayError as error:
                self._replace(worker, number, error)
                return
            if number is None:
                worker.is_ready = True
                continue
            worker.starts = 0
            worker.items.remove(number)
            self._done[number] = result
            for note in notes:
                warn(note)

    def _replace(self, worker: _Worker, number: int | None, error: Exception) -> None:
        """Give the items of a worker that has ended to others, and start another in its place."""
        ray, place = self._ray, worker.place
        with contextlib.suppress(Exception):  # it may only be out of reach
            ray.kill(worker.actor)
        self.workers.remove(worker)
        for each in worker.items:
            heapq.heappush(self._waiting, each)
        self._running = {key: of for key, of in self._running.items() if of[0] is not worker}
        self._losses.update(worker.items[:1])
        reason = one_line(error)[:_REASON]
        if worker.items and self._losses[worker.items[0]] == _TRIES:
            raise InputError(f"{worker}: workers ended {_TRIES} times at the same item: {reason}")
        is_alive = place.node["NodeID"] in {node["NodeID"] for node in _nodes(ray)}
        if is_alive and worker.starts < _TRIES:
            self.workers.append(_Worker(ray, place, self._how, worker.starts + 1))
        elif self.workers:
            warn(f"{worker}: lost, its images go to other nodes: {reason}")
        else:
            raise InputError(f"{worker}: lost, and no other node is left: {reason}")
