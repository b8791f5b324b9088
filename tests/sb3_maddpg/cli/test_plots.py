"""Figures of returns: every policy and agent is in them, with its interval."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from sb3_maddpg.cli import plots


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are written."""
    figures = []
    written = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *args: (figures.append(self), written(self, *args)))
    return figures


def test_returns_are_drawn_with_their_intervals(drawn, tmp_path):
    def row(policy: str, mean: float) -> dict:
        figure = {"mean": mean, "low": mean - 1.0, "high": mean + 2.0}
        alone = {"mean": mean, "low": None, "high": None}
        return {"policy": policy, "env": "e", "episodes": 9, "return": figure, "agents": {"a": {"return": alone}}}

    path = plots.draw_returns([row("x", 1.0), row("y", -3.0)], tmp_path / "new")
    assert path == tmp_path / "new" / "returns.png"
    assert path.stat().st_size > 5000
    (axes,) = drawn[0].axes
    assert [text.get_text() for text in axes.get_yticklabels()] == ["team", "a"]
    assert [one.get_label() for one in axes.containers] == ["x", "y"]
    assert axes.containers[1].lines[0].get_xdata().tolist() == [-3.0, -3.0]
    (bars,) = axes.containers[1].lines[2]
    assert bars.get_segments()[0][:, 0].tolist() == [-4.0, -1.0]
    assert bars.get_segments()[1][:, 0].tolist() == [-3.0, -3.0], "no interval"


def test_the_mean_of_seeds_ends_with_the_shortest(drawn, tmp_path):
    curves = {
        "seed 0": (np.array([10, 20, 30]), np.array([0.0, 1.0, 2.0])),
        "seed 1": (np.array([10, 20]), np.array([2.0, 3.0])),
    }
    assert plots.draw_seeds(curves, "e", tmp_path / "s.png").is_file()
    *_, mean = drawn[0].axes[0].lines
    assert mean.get_xydata().tolist() == [[10, 1.0], [20, 2.0]]
