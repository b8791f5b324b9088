"""The page that replays an episode."""

import io
import json
import re

import numpy as np
from PIL import Image

from quad_swarm.figures.replay import main


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


def test_controls_work_in_a_browser(tmp_path, browser):
    page_file = tmp_path / "replay.html"
    assert main(["--policy", "full", "cpa:0.7:1.5", "--scenario", "symmetric_swap", "--out", str(page_file)]) == 0
    for scheme, size in (("light", (1280, 900)), ("dark", (390, 844))):
        page = browser.new_page(color_scheme=scheme, viewport=dict(zip(("width", "height"), size, strict=True)))
        errors: list[str] = []
        page.on("pageerror", lambda error, errors=errors: errors.append(str(error)))
        page.on("console", lambda message, errors=errors: message.type == "error" and errors.append(message.text))
        page.goto(page_file.as_uri())
        step = page.locator("#time")
        last = int(step.get_attribute("max"))
        assert page.locator("section").count() == 2
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "nothing hangs over the edge"
        asked = page.locator("section p").all_inner_texts()
        data = json.loads(page.locator("#data").text_content())
        for text, flight in zip(asked, data["flights"], strict=True):
            steps = len(flight["requests"])
            assert f"{steps} steps, {sum(map(len, flight['requests']))} of {12 * steps} requests" in text
        first = pixels(page)
        assert len(np.unique(first.reshape(-1, 3), axis=0)) > 50, "the picture is blank"
        assert (first.mean() > 128) == (scheme == "light")

        page.click("#forward")
        page.click("#forward")
        page.click("#back")
        assert step.input_value() == "1"
        page.keyboard.press("ArrowRight")
        assert step.input_value() == "2"
        page.locator("svg.asks").first.click(position={"x": 200, "y": 20})
        assert 2 < int(step.input_value()) < last
        step.fill("0")
        page.select_option("#speed", "4")
        page.click("#play")
        page.wait_for_function(f"document.getElementById('time').value == {last}", timeout=20_000)
        assert page.locator("#play").get_attribute("aria-label") == "Play"  # it stops at the end
        assert (pixels(page) != first).any()
        cursors = page.locator("line.cursor").evaluate_all("lines => lines.map(line => line.getAttribute('x1'))")
        assert len(cursors) == 6
        assert len(set(cursors[:3])) == 1

        turned = pixels(page)
        box = page.locator("canvas").first.bounding_box()
        page.mouse.move(box["x"] + 100, box["y"] + 80)
        page.mouse.down()
        page.mouse.move(box["x"] + 180, box["y"] + 90)
        page.mouse.up()
        assert (pixels(page) != turned).any(), "dragging turns the view"
        assert not errors
        page.close()


def pixels(page) -> np.ndarray:
    """What the first view shows, as RGB."""
    shot = Image.open(io.BytesIO(page.locator("canvas").first.screenshot())).convert("RGB")
    return np.asarray(shot)
