"""The page that replays an episode."""

import hashlib
import io
import itertools
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from quad_swarm.evaluation.flight import Condition, fly
from quad_swarm.evaluation.recordings import Recording, write
from quad_swarm.figures import replay as replay_module
from quad_swarm.figures.replay import _colliding, main
from quad_swarm.world.presets import make_config
from sb3_maddpg.hub.pretrained import pretrained_folder

FIGURES = Path(replay_module.__file__).parent
ANNOUNCING = str(pretrained_folder("quad-swarm-flight") / "model.zip")
SIZES = {"phone": (390, 844), "tablet": (768, 1024), "desktop": (1280, 800), "wide": (1920, 640)}


def data_of(text: str) -> dict:
    return json.loads(re.search(r'<script id="data"[^>]*>(.*?)</script>', text, re.DOTALL)[1])


def test_page_holds_the_flights_of_all_policies(tmp_path):
    page = tmp_path / "pages" / "replay.html"
    arguments = ["--policy", "full", "cpa:0.7:1.5", "none", "--scenario", "asymmetric_swap", "--seed", "3"]
    assert main([*arguments, "--episode", "2", "--out", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"(src|href|from|import)\s*[=(]?\s*[\"'`](https?:)?//", text), "it needs no network"
    full, rule, none = flights = data_of(text)["flights"]
    assert [flight["policy"] for flight in flights] == ["full", "cpa:0.7:1.5", "none"]
    assert [flight["name"] for flight in flights] == ["Full communication", "Rule", "No communication"]
    assert full["positions"][0] == rule["positions"][0] == none["positions"][0]
    for flight in flights:
        steps = len(flight["requests"])
        assert len(flight["positions"]) == len(flight["attitudes"]) == len(flight["separation"]) == steps + 1 > 10
        assert len(flight["plans"]) == steps
        begin = np.array(flight["plans"])[:, :, 0]
        assert np.abs(begin - flight["positions"][:-1]).max() < 0.02, "a plan begins where its robot is"
        colliding = [step for step, separation in enumerate(flight["separation"]) if separation < 0.599]
        assert flight["collision"] == (colliding[0] if colliding else None)
        assert sorted({step for step, _, _ in flight["colliding"]}) == colliding
    assert all(len(step) == 12 for step in full["requests"])
    assert 0 < sum(map(len, rule["requests"])) < sum(map(len, full["requests"]))
    assert not any(none["requests"])


def test_pairs_that_collide_are_those_that_come_closest(tmp_path):
    page = tmp_path / "replay.html"
    arguments = ["--preset", "flight", "--policy", "none", "--scenario", "symmetric_swap", "--n-robots", "6"]
    assert main([*arguments, "--out", str(page)]) == 0
    (flight,) = data_of(page.read_text())["flights"]
    pos = np.array(flight["positions"])
    assert flight["colliding"], "this episode is to have a collision"
    for step in {step for step, _, _ in flight["colliding"]}:
        # Contact at any time of a step: straight from one end to the other, far more finely than robots can tell
        way = pos[step - 1] + np.linspace(0, 1, 50)[:, None, None] * (pos[step] - pos[step - 1])
        apart = np.linalg.norm(way[:, :, None] - way[:, None], axis=-1).min(axis=0)
        pairs = {(i, j) for i in range(6) for j in range(i + 1, 6) if apart[i, j] < 0.59}
        told = {(i, j) for k, i, j in flight["colliding"] if k == step}
        assert pairs <= told
        assert all(apart[pair] < 0.61 for pair in told)


def test_a_pair_that_only_comes_close_is_not_marked_with_the_one_that_collides():
    """Between steps, one pair comes 3 cm closer than on the straight line; another one passes at 0.62 m."""
    flight = fly(Condition("none", "random", make_config("flight", n_robots=4), 3), 0)
    state = flight.state.copy()
    state[..., :3] = [[0, 0, 0], [0.61, 0, 0], [9, 0, 0], [9.62, 0, 0]]
    for least, expected in ((0.58, [[2, 0, 1]]), (0.61, [])):
        closest = np.array([0.61, 0.61, least, 0.61])
        assert _colliding(replace(flight, state=state, min_separation=closest)) == expected


def test_mistakes_are_told_in_one_line(tmp_path, capsys):
    out = ["--out", str(tmp_path / "replay.html")]
    assert main(["--policy", "full", "--scenario", "symetric_swap", *out]) == 1
    assert "symmetric_swap" in capsys.readouterr().err
    assert main(["--policy", "full", "--episode", "-1", *out]) == 1
    assert "count from 0" in capsys.readouterr().err
    assert main(["--policy", "full", "--out", str(tmp_path / "replay.mp3")]) == 1
    assert "use the ending .html" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_dash_writes_the_page_to_the_standard_output(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["--policy", "none", "--max-steps", "5", "--out", "-"]) == 0
    printed = capsys.readouterr().out
    assert [flight["policy"] for flight in data_of(printed)["flights"]] == ["none"]
    assert printed.rstrip().endswith("</html>")
    assert not list(tmp_path.iterdir())


def test_the_page_was_built_from_its_sources():
    sources = FIGURES / "page"
    names = sorted(path.name for path in sources.iterdir() if re.search(r"\.(js|mjs|css|html|json)$", path.name))
    digest = hashlib.sha256()
    for name in names:
        digest.update(f"{name}\n{(sources / name).read_text(encoding='utf-8')}\n".encode())
    page = (FIGURES / "replay.html").read_text(encoding="utf-8")
    assert digest.hexdigest() in page, "run `make page` and commit what it writes"
    licence = (FIGURES / "three.LICENSE.txt").read_text(encoding="utf-8").strip()
    assert "The MIT License" in licence
    assert licence in page
    versions = json.loads((sources / "package.json").read_text())
    pinned = {**versions["dependencies"], **versions["devDependencies"]}
    locked = json.loads((sources / "package-lock.json").read_text())["packages"]
    assert pinned == {name: locked[f"node_modules/{name}"]["version"] for name in pinned}
    assert f"three.js {pinned['three']}" in page
    assert len(page) < 700_000


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> dict[str, Path]:
    """Four robots that ask in two ways, and eight that do not ask and collide, or ask everybody."""
    folder = tmp_path_factory.mktemp("pages")
    four, eight = folder / "four.html", folder / "eight.html"
    scenario = ["--scenario", "symmetric_swap"]
    assert main(["--policy", "full", "cpa:0.7:1.5", *scenario, "--out", str(four)]) == 0
    arguments = ["--preset", "flight", "--policy", "none", "full", *scenario, "--max-steps", "40"]
    assert main([*arguments, "--out", str(eight)]) == 0
    told = folder / "told.html"
    world = ["--world", "noise.wind=1.5", "--plant", "model"]
    assert main(["--policy", "full", ANNOUNCING, "--max-steps", "40", *scenario, *world, "--out", str(told)]) == 0
    return {"four": four, "eight": eight, "told": told}


@pytest.fixture
def view(browser, pages):
    """Opens a page; in the end there must have been no error on it."""
    opened, errors = [], []

    def open_page(name, hash_="step=0", size="desktop", scheme="light", script="", **options):
        width, height = SIZES[size]
        page = browser.new_page(color_scheme=scheme, viewport={"width": width, "height": height}, **options)
        page.set_default_timeout(500_000)  # ms, on a busy machine
        opened.append(page)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: message.type == "error" and errors.append(message.text))
        page.on("request", lambda request: request.url.startswith("http") and errors.append(request.url))
        if script:
            page.add_init_script(script)
        page.goto(f"{pages[name].as_uri()}#{hash_}")
        page.wait_for_function("document.body.dataset.drawn !== undefined")
        return page

    yield open_page
    for page in opened:
        page.close()
    assert not errors


def drawn(page, step: int) -> None:
    page.wait_for_function(f"Number(document.body.dataset.drawn) === {step}")


def painted(page) -> None:
    page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")


def pixels(page, selector: str = "#canvas") -> np.ndarray:
    """What is drawn, as RGB."""
    box = page.locator(selector).bounding_box()
    shot = Image.open(io.BytesIO(page.screenshot(clip=box))).convert("RGB")
    return np.asarray(shot).astype(int)


def number(text: str) -> int:
    return int(re.sub(r"\D", "", text))


@pytest.mark.slow
def test_counters_are_the_sums_of_what_was_asked(view, pages):
    data = data_of(pages["four"].read_text())
    page = view("four", "step=12")
    assert page.inner_text("h1") == "Symmetric swap, 4 robots, world paper"
    assert "held-out episode 0 (set 0)" in page.inner_text("header")
    last = max(len(flight["requests"]) for flight in data["flights"])
    for step in (12, last):
        page.fill("#time", str(step))
        drawn(page, step)
        cells = page.locator("section.cell").all()
        for cell, flight in zip(cells, data["flights"], strict=True):
            until = flight["requests"][: step + 1]
            asked = sum(map(len, until))
            assert number(cell.locator(".asked").inner_text()) == asked
            share = float(cell.locator(".share").inner_text()[:-1])
            assert share == pytest.approx(100 * asked / len(until) / 12, abs=0.05)
    for article, flight in zip(page.locator("article").all(), data["flights"], strict=True):
        total = sum(map(len, flight["requests"]))
        summary = article.locator(".summary").inner_text()
        assert f"{len(flight['requests'])} steps" in summary
        assert re.search(rf"\b{total} of {12 * len(flight['requests'])} plans sent", summary)
        told = article.locator("path.lane").evaluate_all("lanes => lanes.map(lane => Number(lane.dataset.steps))")
        assert sum(told) == total


@pytest.mark.slow
def test_every_pair_of_eight_has_a_lane_that_can_be_seen(view):
    page = view("eight", size="desktop")
    assert page.locator("svg.asks").first.locator("path.lane").count() == 0, "nobody asks"
    full = page.locator("svg.asks").last
    lanes = full.locator("path.lane").evaluate_all(
        "lanes => lanes.map(lane => [lane.dataset.asker, lane.dataset.asked, lane.getBBox().y, lane.getBBox().height])"
    )
    assert {(int(i), int(j)) for i, j, _, _ in lanes} == {(i, j) for i in range(8) for j in range(8) if i != j}
    ordered = sorted((y, y + height) for _, _, y, height in lanes)
    assert all(bottom - top_ >= 3 for top_, bottom in ordered)
    assert all(here[1] <= after[0] for here, after in itertools.pairwise(ordered)), "none hides another"
    assert ordered[-1][1] <= full.bounding_box()["height"]
    assert [int(i) for i, _, _, _ in sorted(lanes, key=lambda lane: lane[2])] == sorted(list(range(8)) * 7), "grouped"

    full.scroll_into_view_if_needed()
    lane = full.locator('path[data-asker="3"][data-asked="5"]').bounding_box()
    page.mouse.move(lane["x"] + lane["width"] * 12.5 / 40, lane["y"] + lane["height"] / 2)
    assert page.inner_text("#tooltip") == "step 12: robot 3 asks robot 5"


@pytest.mark.slow
def test_axis_tells_a_contact_from_a_near_miss(view, pages):
    page = view("four")
    closest = min(data_of(pages["four"].read_text())["flights"][0]["separation"])
    plot = page.locator("svg.separation").first
    contact = float(plot.locator("line.contact").get_attribute("y1"))
    floor = max(float(line.get_attribute("y1")) for line in plot.locator("line.grid").all())
    assert 0.02 * (floor - contact) / 0.6 >= 2, "2 cm are two pixels"
    told = plot.text_content().replace("\N{NO-BREAK SPACE}", " ")
    assert f"minimum {closest:.2f} m" in told
    assert "contact 0.60 m" in told
    dot = float(plot.locator("circle.minimum").get_attribute("cy"))
    assert dot == pytest.approx(floor - (floor - contact) * closest / 0.6, abs=0.1)
    assert plot.locator("path.clipped").count() == 1, "robots begin farther apart than the axis reaches"


@pytest.mark.slow
def test_collision_is_shown_when_it_happens(view, pages):
    none = data_of(pages["eight"].read_text())["flights"][0]
    step = none["collision"]
    page = view("eight", f"step={step - 1}")
    badges = page.locator(".badge")
    assert [badge.is_visible() for badge in badges.all()] == [False, False]
    before = reddish(pixels(page))
    page.click("#forward")
    drawn(page, step)
    assert [badge.is_visible() for badge in badges.all()] == [True, False]
    assert badges.first.inner_text() == f"collision at step {step}"
    page.add_style_tag(content=".badge { visibility: hidden }")
    assert reddish(pixels(page)) > before + 100, "the two that collide are in red"


def reddish(picture: np.ndarray) -> int:
    red, green, blue = np.moveaxis(picture, -1, 0)
    return int(((red > 150) & (green < 90) & (blue < 90)).sum())


@pytest.mark.slow
@pytest.mark.parametrize(("scheme", "sizes"), [("dark", ("phone", "wide")), ("light", ("desktop", "tablet"))])
def test_page_fits_and_is_not_blank(view, scheme, sizes):
    page = view("four", "step=20", sizes[0], scheme)
    drawn(page, 20)
    for size in sizes:
        page.set_viewport_size(dict(zip(("width", "height"), SIZES[size], strict=True)))
        painted(page)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "nothing hangs over the edge"
        bar = page.locator("#controls").bounding_box()
        for index, cell in enumerate(page.locator("section.cell").all()):
            box = cell.bounding_box()
            assert box["y"] + box["height"] <= bar["y"], "all policies are seen without scrolling"
            assert box["height"] >= 180
            picture = pixels(page, f"section.cell >> nth={index}")
            assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200, "the picture is blank"
            assert (picture.mean() > 128) == (scheme == "light")
    page.click("#theme")
    painted(page)
    assert (pixels(page).mean() > 128) == (scheme == "dark")


def test_text_can_be_read_on_its_ground():
    """WCAG 2's contrast, in both themes."""
    style = (FIGURES / "page" / "page.css").read_text()
    light, dark = (
        dict(re.findall(r"--([\w-]+): (#\w{6});", block))
        for block in re.findall(r":root.*?\{(.*?)\}", style, re.DOTALL)
    )

    def luminance(colour: str) -> float:
        parts = (int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))
        linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
        return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))

    for theme in (light, dark):
        pairs = itertools.product(("ink", "faint", "alarm"), ("ground", "panel", "view", "track"))
        for ink, ground in (*pairs, ("ground", "accent")):
            one, other = sorted((luminance(theme[ink]), luminance(theme[ground])))
            assert (other + 0.05) / (one + 0.05) >= 4.5, (ink, ground)
        for fill in ("alarm-fill", "good-fill"):
            assert 1.05 / (luminance(theme[fill]) + 0.05) >= 4.5, fill


def test_step_in_the_address(view):
    page = view("four", "step=7")
    assert page.locator("#play").get_attribute("aria-label") == "Play", "a given step does not play"
    assert page.input_value("#time") == "7"
    page.keyboard.press("ArrowRight")
    drawn(page, 8)
    assert "step=8" in page.url
    page.locator("svg.asks").first.click(position={"x": 200, "y": 20})
    step = int(page.input_value("#time"))
    assert step > 8
    assert f"step={step}" in page.url
    page.keyboard.press("End")
    assert page.input_value("#time") == page.get_attribute("#time", "max")
    page.keyboard.press("Home")
    drawn(page, 0)
    page.click("#forward")
    page.click("#forward")
    page.click("#back")
    drawn(page, 1)
    cursors = page.locator("line.cursor").evaluate_all("lines => lines.map(line => line.getAttribute('x1'))")
    assert len(cursors) == 6
    assert len(set(cursors)) == 1, "all plots show the same time"


@pytest.mark.slow
def test_every_listed_key_works_wherever_the_focus_is(view):
    page = view("four", "step=7")
    listed = page.locator("#about dt").all_text_contents()
    assert [text for text in listed if "Space" in text or "?" in text] == ["Space", "?"]
    dialog = "document.getElementById('about').open"
    for focused in ("#canvas", "#time", "#speed", "#view", "#follow", "#loop", "#help"):
        page.focus(focused)
        page.keyboard.press("?")
        assert page.evaluate(dialog), focused
        page.keyboard.press("ArrowRight")
        assert page.input_value("#time") == "7", "the list is in front"
        page.keyboard.press("?")
        assert not page.evaluate(dialog), focused
        page.keyboard.press("Shift+?")
        page.keyboard.press("Escape")
        assert not page.evaluate(dialog), focused
    for focused in ("#canvas", "#time", "#loop"):
        page.focus(focused)
        page.keyboard.press("Home")
        drawn(page, 0)
        page.keyboard.press("ArrowRight")
        page.keyboard.press("ArrowRight")
        page.keyboard.press("ArrowLeft")
        drawn(page, 1)
        for key, view_ in zip("2341", ("top", "side", "chase", "perspective"), strict=True):
            page.keyboard.press(key)
            assert page.input_value("#view") == view_, (focused, key)
        for key in ("w", "A", "s", "d", "+", "-", "Shift+ArrowUp", "Shift+ArrowLeft"):
            page.keyboard.press("1")
            page.keyboard.press(key)
            assert page.input_value("#view") == "", (focused, key)
        drawn(page, 1)
        page.keyboard.press("End")
        assert page.input_value("#time") == page.get_attribute("#time", "max")


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", ["phone", "wide"])
def test_no_two_things_have_the_same_sign_in_the_legend(view, size, scheme):
    page = view("told", size=size, scheme=scheme)
    items = page.locator("#legend li").all()
    texts = [item.inner_text() for item in items]
    assert any(text.startswith("request:") for text in texts)
    assert any(text.startswith("announced plan, sent unasked:") for text in texts)
    signs = [item.locator("i").screenshot() for item in items]
    assert len(set(signs)) == len(signs) == len(texts)


@pytest.mark.slow
def test_announced_plans_are_drawn_and_counted_apart_from_requests(view, pages):
    data = data_of(pages["told"].read_text())
    steps = data["flights"][1]["requests"]
    step = next(k for k, pairs in enumerate(steps) if any(len(pair) == 3 for pair in pairs))
    page = view("told", f"step={step}")
    sent = sum(map(len, steps[: step + 1]))
    assert page.locator(".count").last.inner_text().split()[:3] == [str(sent), "plans", "sent"]
    assert "plans sent (" in page.locator(".summary").last.inner_text()
    assert "each request that arrives, or announced without one" in page.locator("#about-text").text_content()
    text = pages["told"].read_text()
    pages["solid"] = pages["told"].with_name("solid.html")
    pages["solid"].write_text(text.replace("discard;", ";"))
    differ = (pixels(page) != pixels(view("solid", f"step={step}"))).any(axis=2)
    assert not differ[:, : differ.shape[1] // 2].any(), "requests are drawn as before"
    assert differ.sum() > 20, "announced plans are dashed"


@pytest.mark.slow
def test_the_page_says_what_differs_from_the_preset(view):
    header = view("told").inner_text("header")
    assert "held-out episode 0 (set 0), noise.wind=1.5, plant=model" in header


@pytest.mark.slow
def test_a_recording_of_positions_has_requests_and_no_plans(view, pages, tmp_path):
    flown = fly(Condition("full", "symmetric_swap", make_config("paper", n_robots=3), 20), 0)
    write(tmp_path / "lab.csv", Recording.of(flown))
    pages["lab"] = tmp_path / "lab.html"
    words = ["--flight", str(tmp_path / "lab.csv"), "--world", "goal_radius=0.2", "--out", str(pages["lab"])]
    assert main(words) == 0
    page = view("lab", "step=5")
    assert page.locator(".count").inner_text().split()[1] == "requests"
    assert "plan for the next" not in page.inner_text("#legend")


@pytest.mark.slow
def test_plays_by_itself_once_and_loops_on_request(view):
    page = view("four", hash_="", size="phone")
    page.wait_for_function("Number(document.body.dataset.drawn) > 1")
    page.click("#more")
    page.select_option("#speed", "4")
    last = page.get_attribute("#time", "max")
    page.wait_for_function("document.getElementById('play').getAttribute('aria-label') === 'Play'")
    assert page.input_value("#time") == last
    assert f"step={last}" in page.url
    page.click("#loop")
    page.click("#play")
    page.wait_for_function(f"document.getElementById('time').value === '{last}'")
    page.wait_for_function("Number(document.getElementById('time').value) < 10")
    page.keyboard.press("Escape")
    page.click("#play")
    assert page.locator("#play").get_attribute("aria-label") == "Play"
    still = view("four", hash_="", size="phone", reduced_motion="reduce")
    assert still.locator("#play").get_attribute("aria-label") == "Play"


@pytest.mark.slow
def test_camera_turns_follows_and_has_presets(view, pages):
    page = view("four", "step=0", reduced_motion="reduce")
    seen = [pixels(page)]

    def changed(why: str) -> None:
        painted(page)
        picture = pixels(page)
        assert all((picture != other).any() for other in seen), why
        seen.append(picture)

    box = page.locator("section.cell").first.bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 300)
    page.mouse.down()
    page.mouse.move(box["x"] + 180, box["y"] + 310)
    page.mouse.up()
    changed("dragging turns the view")
    page.keyboard.press("d")
    changed("keys turn the view")
    page.mouse.wheel(0, -300)
    changed("the wheel zooms")
    for preset in ("top", "side", "chase"):
        page.select_option("#view", preset)
        changed(preset)
        assert f"view={preset}" in page.url
    assert page.input_value("#follow") == "0", "somebody has to be chased"
    page.keyboard.press("Escape")
    page.select_option("#follow", "2")
    changed("following")
    assert "follow=2" in page.url
    page.focus("#follow")
    page.keyboard.press("Escape")
    assert "follow" not in page.url

    page.select_option("#view", "top")
    painted(page)
    picture = pixels(page, "section.cell >> nth=0")
    colour = data_of(pages["four"].read_text())["colours"][3]
    rgb = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    rows, columns = np.nonzero(np.abs(picture - rgb).max(axis=-1) <= 2)  # behind the number of robot 3
    page.mouse.click(box["x"] + np.median(columns), box["y"] + np.median(rows))
    assert page.input_value("#follow") == "3"


@pytest.mark.slow
def test_fingers_zoom(view):
    page = view("four", size="phone", has_touch=True, reduced_motion="reduce")
    before = pixels(page)
    session = page.context.new_cdp_session(page)

    def touch(kind: str, *columns: int) -> None:
        points = [{"x": x, "y": 300, "id": finger} for finger, x in enumerate(columns)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", 150, 240)
    touch("touchMove", 120, 270)
    touch("touchMove", 90, 300)
    touch("touchEnd")
    painted(page)
    assert (pixels(page) != before).any()
    assert page.evaluate("[visualViewport.scale, scrollY]") == [1, 0], "the page itself stays"


@pytest.mark.slow
def test_pictures_and_videos_can_be_saved(view):
    page = view("four", "step=20", "wide")
    page.add_style_tag(content="#stage { grid-auto-rows: 200px !important }")
    with page.expect_download() as saved:
        page.click("#png")
    assert saved.value.suggested_filename == "symmetric_swap_4_robots_step20.png"
    with Image.open(saved.value.path()) as picture:
        assert picture.width > 1500
        assert len(picture.convert("RGB").getcolors(2**24)) > 1000
    page.select_option("#speed", "4")
    with page.expect_download() as saved:
        page.click("#webm")
    assert saved.value.suggested_filename == "symmetric_swap_4_robots.webm"
    video = Path(saved.value.path()).read_bytes()
    assert video[:4] == b"\x1aE\xdf\xa3", "EBML, as all WebM"
    assert len(video) > 2_000, "more than a header"
    page.evaluate("window.MediaRecorder = undefined")
    page.click("#webm")
    page.wait_for_selector("#message:not([hidden]) >> text=cannot record")


def test_without_webgl_the_rest_works(view):
    script = """const real = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
          return kind.startsWith("webgl") ? null : real.call(this, kind, ...more);
        };"""
    page = view("four", "step=12", script=script)
    assert "needs WebGL" in page.inner_text("#no-webgl")
    assert page.locator("path.lane").count() > 12
    page.click("#forward")
    drawn(page, 13)
    assert number(page.locator(".asked").first.inner_text()) == 14 * 12
    assert page.is_disabled("#png")


@pytest.mark.slow
def test_frames_for_scripts_depend_on_their_time_alone(browser, pages):
    page = browser.new_page()
    page.set_default_timeout(500_000)
    page.goto(f"{pages['four'].as_uri()}#hero")
    options = {"width": 480, "height": 240, "ratio": 1, "theme": "dark"}
    assert 1 < page.evaluate("prepare", options) < 10
    first, later, again = (page.evaluate("renderFrame", time) for time in (0.52, 1.5, 0.52))
    assert first == again != later
    assert page.evaluate("[document.querySelector('#stage canvas').width, innerWidth]")[0] == 480
    page.close()


def test_recorded_flights_are_replayed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    flown = fly(Condition("full", "symmetric_swap", make_config("paper", n_robots=3), 20), 0)
    write(Path("lab.csv"), Recording.of(flown))
    write(Path("flight.npz"), Recording.of(flown, "full"))
    assert main(["--flight", "lab.csv", "flight.npz", "--world", "goal_radius=0.2", "--out", "page.html"]) == 0
    page = Path("page.html").read_text()
    data = json.loads(page.split('<script id="data" type="application/json">')[1].split("</script>")[0])
    assert data["source"] == "lab.csv, flight.npz"
    assert data["dt"] == pytest.approx(0.1)
    lab, full = data["flights"]
    assert (lab["policy"], full["policy"]) == ("lab.csv", "full")
    assert (lab["name"], full["name"]) == ("lab.csv", "Full communication")
    assert lab["positions"] == full["positions"] == flown.pos.round(3).tolist()
    assert lab["requests"] == full["requests"]
    assert len(full["requests"][0]) == 6
    for words in ([], ["--flight", "lab.csv", "--policy", "full"]):
        assert main([*words, "--out", "page.html"]) == 1
        assert "--policy" in capsys.readouterr().err


def test_the_page_holds_obstacles_ellipsoids_and_radii(tmp_path):
    page = tmp_path / "replay.html"
    arguments = ["--preset", "flight", "--policy", "none", "--n-robots", "4", "--max-steps", "40", "--out", str(page)]
    assert main([*arguments, "--scenario", "crossing_traffic", "--world", "planner.downwash=2"]) == 0
    data = data_of(page.read_text())
    (flight,) = data["flights"]
    assert data["downwash"] == 2
    assert 2 <= len(flight["obstacles"]) <= 4
    steps = len(flight["requests"])
    for one in flight["obstacles"]:
        assert one["shape"] == "sphere"
        places = np.array(one["positions"])
        assert places.shape == (steps + 1, 3)
        np.testing.assert_allclose(np.diff(places, axis=0), np.diff(places, axis=0)[:1].repeat(steps, 0), atol=0.003)
    assert len(flight["obstacle_distance"]) == steps + 1
    hit = {step for step, distance in enumerate(flight["obstacle_distance"]) if step and distance < -0.001}
    assert {step for step, _, _ in flight["hitting"]} == hit
    assert main([*arguments, "--scenario", "forest"]) == 0
    data = data_of(page.read_text())
    assert all(len(one["positions"]) == 1 for one in data["flights"][0]["obstacles"]), "pillars stand"
    assert main([*arguments, "--scenario", "random"]) == 0
    plain = data_of(page.read_text())
    assert "downwash" not in plain
    assert set(data["flights"][0]) - set(plain["flights"][0]) == {"obstacles", "hitting", "obstacle_distance"}
    assert "radii" not in plain
    assert main([*arguments, "--scenario", "random", "--world", "vehicles=[{radius: 0.2}, {radius: 0.5}]"]) == 0
    assert data_of(page.read_text())["radii"] == [0.2, 0.5, 0.2, 0.5]


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_obstacles_are_drawn_and_explained(browser, tmp_path, scheme):
    shots = []
    for name, radius in (("plain", None), ("pillar", 0.6)):
        page = tmp_path / f"{name}.html"
        listed = [] if radius is None else ["--world", f"obstacles.listed=[{{position: [0, 0, 0], radius: {radius}}}]"]
        arguments = ["--preset", "flight", "--n-robots", "4", "--policy", "none", "--scenario", "symmetric_swap"]
        assert main([*arguments, *listed, "--max-steps", "10", "--out", str(page)]) == 0
        tab = browser.new_page(color_scheme=scheme, viewport={"width": 800, "height": 600})
        tab.goto(f"{page.as_uri()}#step=0&view=top", timeout=300_000)
        tab.wait_for_function("document.body.dataset.drawn !== undefined", timeout=300_000)
        painted(tab)
        shots.append(pixels(tab))
        assert tab.locator("#legend .body").count() == (radius is not None)
        tab.close()
    assert (np.abs(shots[0] - shots[1]).max(axis=-1) > 12).sum() > 1000, "seen from above, it is a disc"
