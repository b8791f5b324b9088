"""One thread per process, since the networks are small and the tests run in parallel, and no traces in the home."""

import os
import shutil
import signal

import pytest

# Whoever starts the tests in the background, as scripts and cron do, ignores interrupts, and children inherit that
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

os.environ.setdefault("OMP_NUM_THREADS", "1")


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
