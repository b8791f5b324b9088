"""The study of swarms that send no messages: what its grids found, and how their points fly."""

import json
from pathlib import Path

from quad_swarm.planner import PROBLEMS, SOLVERS, OrcaSolver, PlannerConfig, VoronoiCells, make_problem
from quad_swarm.quadrotor import QuadrotorParams
from studies import rivals

ROOT = Path(__file__).parents[2]
DATA = ROOT / "studies" / "data"


def recorded(name: str) -> list[dict]:
    return json.loads((DATA / name).read_text())


def test_defaults_are_the_points_that_won():
    rows = recorded("rivals_choice.json")
    orca, cells = (max((row for row in rows if row["kind"] == kind), key=rivals.merit) for kind in ("orca", "voronoi"))
    solver = OrcaSolver(make_problem(PlannerConfig(), QuadrotorParams(), 1))
    assert {name: getattr(solver, name) for name in orca["parameters"]} == orca["parameters"]
    values = dict(cells["parameters"])
    assert values.pop("seconds") == rivals.SWARMS["Voronoi cells"][2]
    assert {name: getattr(VoronoiCells, name) for name in values} == values


def test_points_of_a_grid_fly_with_their_parameters_alone(monkeypatch):
    monkeypatch.setattr(rivals, "WORLDS", ("paper",))
    monkeypatch.setattr(rivals, "SCENARIOS", ("symmetric_swap",))
    monkeypatch.setattr(rivals, "N_ROBOTS", 3)
    slow, fast = (rivals._fly_point("orca", {"speed": speed}, 2) for speed in (1.0, 3.0))
    assert slow["seconds"] > fast["seconds"]
    assert (fast["episodes"], fast["in_time"], fast["collisions"]) == (2, 2, 0)
    assert (SOLVERS["orca"], PROBLEMS["voronoi"]) == (OrcaSolver, VoronoiCells)


def test_crowds_are_flown_with_both_points(monkeypatch):
    monkeypatch.setattr(rivals, "CROWDS", (("symmetric_swap", 3),))
    rows = list(rivals.measure_crowds(2))
    assert [row["swarm"] for row in rows] == ["ORCA, parameters of free rooms", "ORCA, parameters of crowds"]
    assert {row["arrived"] for row in rows} == {2}
    closest = [row["min_separation_quantiles"] for row in rows]
    assert closest[0] != closest[1], "the parameters differ"
    assert SOLVERS["orca"] is OrcaSolver


def test_the_point_of_crowds_won_where_it_was_chosen():
    best = max(recorded("rivals_choice_crowds.json"), key=rivals.merit)["parameters"]
    solver = OrcaSolver(make_problem(PlannerConfig(), QuadrotorParams(), 1))
    own = {name: getattr(solver, name) for name in best}
    assert {name: value for name, value in best.items() if value != own[name]} == rivals.POINTS["of crowds"]
