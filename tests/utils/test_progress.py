"""The bar of long work."""

import pytest

from crisalad_jax.utils.progress import progress_bar


def test_the_note_alone_gives_way_at_80_columns(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("COLUMNS", "80")
    note = "loss 1.465  easy anchors 0.00  5 images/s  best R@5 88.3"
    with progress_bar("training", 180, "steps", quiet=False) as bar:
        for _ in range(2):  # a rate takes two
            bar.advance(41, note=note)
    (line,) = capfd.readouterr().err.splitlines()
    assert len(line) <= 80
    assert " 46% 82/180 " in line
    assert "steps/s" in line
    assert "loss 1.465" in line
    assert line.endswith("…")
