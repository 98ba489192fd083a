"""What the machine lets this process have."""

import resource

from crisalad_jax.utils.host import most_files


def test_files_that_may_be_open(monkeypatch):
    monkeypatch.setattr(resource, "getrlimit", lambda _: (64, 4096))
    assert most_files() == 64
    monkeypatch.setattr(resource, "getrlimit", lambda _: (resource.RLIM_INFINITY, 4096))
    assert most_files() == 2**20
