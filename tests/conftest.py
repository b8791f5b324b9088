"""One thread per process, since the networks are small and the tests run in parallel, and no traces in the home."""

import os
import shutil
import signal
import sys

import pytest

# Whoever starts the tests in the background, as scripts and cron do, ignores interrupts, and children inherit that
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

os.environ.setdefault("OMP_NUM_THREADS", "1")

# What imports register is there before the first test, so that tests which put registries back do not drop it for good
import quad_swarm  # noqa: F401
import sb3_maddpg.team.toys  # noqa: F401

_OF_PETTINGZOO = "sb3_maddpg.team.pettingzoo:make"
_REGISTRIES = (
    ("quad_swarm.task.rules", "RULES"),
    ("quad_swarm.task.observation", "GROUPS"),
    ("quad_swarm.world.scenarios", "SCENARIOS"),
    ("quad_swarm.planner", "SOLVERS"),
    ("quad_swarm.planner", "PROBLEMS"),
    ("quad_swarm.plants.base", "SIMULATORS"),
)


@pytest.fixture(autouse=True)
def _registries():
    """What a test registers is gone after it, so that tests may run in any order."""
    registries = [getattr(sys.modules[module], name) for module, name in _REGISTRIES if module in sys.modules]
    before = [dict(registry) for registry in registries]
    import gymnasium

    ids = set(gymnasium.registry)
    yield
    for registry, entries in zip(registries, before, strict=True):
        if registry.keys() != entries.keys():
            registry.clear()
            registry.update(entries)
    for env_id in set(gymnasium.registry) - ids:
        if gymnasium.registry[env_id].entry_point == _OF_PETTINGZOO:  # registered again where it is needed
            del gymnasium.registry[env_id]


@pytest.fixture(scope="session")
def browser():
    """A headless Chromium. Tests that need one are skipped where there is none."""
    sync_api = pytest.importorskip("playwright.sync_api")
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with sync_api.sync_playwright() as driver:
        if path is None and not os.path.exists(driver.chromium.executable_path):
            pytest.skip("no Chromium: install one, or `playwright install chromium`")
        # WebGL without a graphics card
        software = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        arguments = ["--no-sandbox", "--disable-background-networking", "--no-first-run", *software]
        chromium = driver.chromium.launch(executable_path=path, args=arguments)
        yield chromium
        chromium.close()
