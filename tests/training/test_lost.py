"""What a process says where another one is lost."""

import signal
import subprocess
import sys

import pytest

from crisalad_jax.training import lost
from crisalad_jax.utils.errors import InputError, Interrupted
from tests.training.programs import COMPILED_SOON, ROOT

ABORTED = """
import os, sys
from crisalad_jax.training.lost import filter_aborts
filter_aborts()
print("a result", flush=True)  # which an abort would lose in its buffer
print("a note", file=sys.stderr)
os.write(1, b"[Gloo] Rank 0 is connected to 3 peer ranks. Expected ... is : 3\\n")
os.write(2, b"what OpenCV says\\n")
os.abort()
"""
# As jaxlib 0.10.2 writes it, with fewer words.
POLLED = """E1127 21:34:32.180709   29868 coordination_service.cc:1549] [1] Use error polling to
propagate: UNAVAILABLE: The following tasks are unhealthy (stopped sending heartbeats):
2
The tasks have crashed.
"""
SOCKET = """E1127 21:38:10.78 1 coordination_service_agent.cc:289] Polled an error from service.
"""
FATAL = """F1127 21:38:10.7 1 client.h:80] Terminating process because the JAX distributed service
detected fatal errors. Either the leader task was preempted or
*** Check failure stack trace: ***
    @     0x7f134a240634  absl::lts_20260107::log_internal::LogMessage::SendToLog()
"""
LINE = "crisalad: processes: lost process {}; the same command resumes from the last saved state"


@pytest.mark.parametrize(
    ("page", "said"),
    [
        (POLLED + FATAL, LINE.format(2)),
        (SOCKET + FATAL, LINE.format(0)),  # its service is lost, and is in process 0
        (POLLED, ""),  # no page of an end
        (POLLED + "crisalad: ended by SIGTERM\n", "crisalad: ended by SIGTERM"),
    ],
)
def test_a_page_of_jax_becomes_a_line(page, said):
    done = subprocess.run(
        [sys.executable, "-ISc", lost._FILTER, lost._NEXT],
        input=f"what OpenCV says\n{page}",
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.stderr.startswith(f"what OpenCV says\n{said}")
    assert done.stderr.count("\n") == 1 + bool(said)


def test_what_python_writes_goes_where_it_went():
    done = subprocess.run(
        [sys.executable, "-c", ABORTED],
        cwd=ROOT,
        env=COMPILED_SOON,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == -signal.SIGABRT
    assert done.stdout == "a result\n"
    assert sorted(done.stderr.splitlines()) == ["a note", "what OpenCV says"]


@pytest.fixture
def leaving(monkeypatch) -> list:
    """What was asked for at the end of the process; there are two."""
    asked: list = []
    monkeypatch.setattr(lost.atexit, "register", asked.append)
    monkeypatch.setattr(lost.jax, "process_count", lambda: 2)
    return asked


@pytest.mark.parametrize(
    ("error", "lost_one"),
    [
        (ValueError("UNKNOWN: Gloo AllGather failed: Read error [::1]:1: Connection reset"), True),
        (RuntimeError("INTERNAL: NCCL operation ncclAllReduce(...) failed"), True),
        (RuntimeError("INTERNAL: cuDNN"), False),
        (InputError("gloo.csv: found nothing"), False),
        (Interrupted(15), False),
    ],
)
def test_an_exchange_that_failed_is_a_line(leaving, error, lost_one):
    @lost.ends_with_the_others
    def exchange(raised: Exception) -> None:
        raise raised

    with pytest.raises(InputError if lost_one else type(error)) as caught:
        exchange(error)
    assert len(leaving) == lost_one
    if lost_one:
        assert str(caught.value).startswith("processes: lost another process (")
        assert "\n" not in str(caught.value)


def test_one_process_has_no_other_to_lose():
    @lost.ends_with_the_others
    def read() -> None:
        raise ValueError("gloo")

    with pytest.raises(ValueError, match=r"^gloo$"):
        read()
