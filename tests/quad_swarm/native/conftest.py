"""Compiled code and its NumPy twins."""

import pytest

from quad_swarm.native import pairs


@pytest.fixture(params=["compiled", "numpy"])
def either(request, monkeypatch) -> None:
    """Both ways of computing, one after the other."""
    if request.param == "numpy":
        monkeypatch.setattr(pairs, "compiled", lambda: None)
    else:
        assert pairs.compiled() is not None
