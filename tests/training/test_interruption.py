"""A run that is told to stop saves first, and goes on (tests/attack kills and signals commands)."""

import signal

import pytest

from crisalad_jax.training import trainer, validation
from crisalad_jax.training.loop import fit
from crisalad_jax.utils.errors import Interrupted
from tests.training.test_loop import ENDLESS, assert_same_run


@pytest.fixture(params=[signal.SIGTERM, signal.SIGINT], ids=lambda number: number.name)
def number(request):
    """A signal that does no harm to the tests where a run would not handle it."""
    before = signal.signal(request.param, lambda *_: None)
    yield request.param
    signal.signal(request.param, before)


@pytest.mark.parametrize(
    ("module", "function", "call", "saved"),
    [
        (trainer, "train_step", 3, 3),
        (validation, "evaluate", 1, 2),  # it is left at once, and repeated
    ],
)
def test_a_signal_saves_first_and_the_same_command_goes_on(
    places, benchmark, params, run, tmp_path, monkeypatch, number, module, function, call, saved
):
    calls = []
    given = {"validation": benchmark, "initial": params, "quiet": True}
    original = getattr(module, function)

    def signalled(*arguments, **options):
        calls.append(None)
        if len(calls) == call:
            signal.raise_signal(number)
            calls.append("after the signal")
        return original(*arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(module, function, signalled)
        words = f"after step {saved}; the same command resumes"
        with pytest.raises(Interrupted, match=words) as stopped:
            fit(ENDLESS, places, tmp_path / "run", **given)
    assert stopped.value.number == number
    assert ("after the signal" in calls) == (module is trainer)
    assert max(int(path.name) for path in (tmp_path / "run" / "state").iterdir()) == saved
    fit(ENDLESS, places, tmp_path / "run", **given)
    assert_same_run(tmp_path / "run", run)
