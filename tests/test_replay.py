"""The page that replays an episode."""

import json
import re

from quad_swarm.replay import main


def test_page_holds_the_flights_of_all_policies(tmp_path):
    page = tmp_path / "pages" / "replay.html"
    arguments = ["--policy", "full", "cpa:0.7:1.5", "none", "--scenario", "asymmetric_swap", "--seed", "3"]
    assert main([*arguments, "--episode", "2", "--out", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"(src|href)=.https?:", text), "it needs no network"
    data = json.loads(re.search(r'<script id="data"[^>]*>(.*?)</script>', text, re.DOTALL)[1])
    full, rule, none = data["flights"]
    assert [flight["policy"] for flight in data["flights"]] == ["full", "cpa:0.7:1.5", "none"]
    assert full["positions"][0] == rule["positions"][0] == none["positions"][0]
    for flight in data["flights"]:
        steps = len(flight["requests"])
        assert len(flight["positions"]) == len(flight["plans"]) == len(flight["separation"]) == steps + 1 > 10
        assert flight["collision"] == (min(flight["separation"]) < 0.599)
    assert all(len(step) == 12 for step in full["requests"])
    assert 0 < sum(map(len, rule["requests"])) < sum(map(len, full["requests"]))
    assert not any(none["requests"])


def test_mistakes_are_told_in_one_line(tmp_path, capsys):
    out = ["--out", str(tmp_path / "replay.html")]
    assert main(["--policy", "full", "--scenario", "symetric_swap", *out]) == 2
    assert "symmetric_swap" in capsys.readouterr().err
    assert main(["--policy", "full", "--episode", "-1", *out]) == 2
    assert "counted from 0" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
