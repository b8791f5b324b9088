"""The page that follows a flight."""

import json
import urllib.error
import urllib.request

import numpy as np
import pytest

from quad_swarm.evaluation.flight import Condition, fly
from quad_swarm.figures.live import LivePage
from quad_swarm.realtime.process import Report, Sample
from quad_swarm.world.presets import for_scenario, make_config
from quad_swarm.world.scenarios import Scene

CONFIG = make_config("paper", n_robots=3)


@pytest.fixture(scope="module")
def flown():
    return fly(Condition("full", "symmetric_swap", CONFIG, 70), 0)


@pytest.fixture
def live():
    with LivePage(CONFIG) as page:
        yield page


def samples(flight):
    """What an arena would see."""
    n = flight.n_robots
    for k, state in enumerate(flight.state):
        others = [sum(1 << j for j in range(n) if j != i) for i in range(n)]
        reports = [Report(i, 0, others[i], 0, others[i], flight.plans[k, i, :, :3]) for i in range(n)]
        yield Sample(0.1 * k, state, np.zeros((n, 4)), reports)


def scene(flight):
    return Scene(flight.pos[0], flight.goal, flight.obstacles)


def get(live, path=""):
    with urllib.request.urlopen(live.url + path, timeout=500) as answer:
        assert answer.headers["Content-Type"].startswith("text/html")
        return answer.read().decode()


def test_steps_are_those_of_the_replay_page(live, flown):
    live.begin("full", scene(flown))
    every = list(samples(flown))
    for sample in every[:5]:
        live.add(sample)
    page = get(live)
    data = json.loads(page.split('<script id="data" type="application/json">')[1].split("</script>")[0])
    (flight,) = data["flights"]
    assert (data["live"], data["source"], len(flight["requests"])) == (1, "flight 1", 4)
    assert flight["positions"] == flown.pos[:5].round(3).tolist()
    for sample in every[5:]:
        live.add(sample)
    live.end()
    told = []
    for event in live.events(1, 4):
        if event.startswith("event: end"):
            break
        told.append(json.loads(event.split("data: ")[1]))
    assert len(told) == len(flown.requests) - 4
    assert [step["positions"] for step in told] == flown.pos[5:].round(3).tolist()
    assert all(len(step["requests"]) == 6 for step in told)
    assert flown.arrival is not None
    assert [step["arrived"] for step in told].index(True) + 5 == flown.arrival
    assert not any(step["colliding"] for step in told)


def test_the_next_flight_begins_anew(live, flown):
    live.begin("full", scene(flown))
    for sample in samples(flown):
        live.add(sample)
    events = live.events(1, 68)
    assert next(events).startswith("id: 69\n")
    assert next(events).startswith("id: 70\n")
    assert next(events) == ": nothing yet\n\n"
    live.end()
    assert next(events) == "event: end\ndata: \n\n"
    live.begin("none", scene(flown))
    assert next(events) == "event: begin\ndata: \n\n"
    assert list(events) == []


def test_obstacles_are_shown_where_they_are(live):
    flight = fly(Condition("full", "crossing_traffic", for_scenario(CONFIG, "crossing_traffic"), 10), 0)
    live.begin("full", scene(flight))
    for sample in list(samples(flight))[:4]:
        live.add(sample)
    page = get(live)
    data = json.loads(page.split('<script id="data" type="application/json">')[1].split("</script>")[0])
    shown = np.array([one["positions"] for one in data["flights"][0]["obstacles"]])
    np.testing.assert_allclose(shown, flight.obstacle_pos[:4].transpose(1, 0, 2), atol=2e-3)


@pytest.mark.parametrize(("path", "status"), [("other", 404), ("events", 400), ("events?flight=one&from=0", 400)])
def test_other_addresses_are_errors(live, path, status):
    with pytest.raises(urllib.error.HTTPError) as error:
        urllib.request.urlopen(live.url + path, timeout=500)
    assert error.value.code == status


def test_only_this_machine_is_served(live):
    assert live.url.startswith("http://127.0.0.1:")


@pytest.mark.slow
def test_a_browser_follows(live, flown, browser):
    every = list(samples(flown))
    live.begin("full", scene(flown))
    for sample in every[:3]:
        live.add(sample)
    page = browser.new_page()
    page.set_default_timeout(500_000)  # ms, on a busy machine
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(live.url)
    page.wait_for_function("document.body.dataset.live === 'live'")
    for sample in every[3:20]:
        live.add(sample)
    page.wait_for_function("Number(document.body.dataset.drawn) > 18.5")
    assert page.inner_text("#subtitle") == "flight 1, live"
    assert page.inner_text(".asked") == str(19 * 6)
    for sample in every[20:]:
        live.add(sample)
    live.end()
    page.wait_for_function("document.body.dataset.live === 'landed'")
    page.wait_for_function("document.getElementById('time').max === '70'")
    assert page.inner_text(".summary").startswith("70 steps")
    live.begin("none", scene(flown))
    for sample in every[:3]:
        live.add(sample)
    page.wait_for_function("document.getElementById('subtitle').textContent === 'flight 2, live'")
    assert not errors
    page.close()
