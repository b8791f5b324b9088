"""Render the README's animation: ``python -m studies.swarm.hero --policy none full MODEL.zip [--out DIR]``.

All policies fly the same held-out episode, the first ``--without-predictor`` of them at constant velocities. The page
of `sb3-maddpg replay` draws each frame in a headless Chromium with its function ``renderFrame(seconds)``, so frames do
not depend on the machine's speed. This writes ``hero-light.webp`` and ``hero-dark.webp``; the README's with ``--preset
flight-v3 --policy none full envs/quad_swarm/models/quad-swarm-flight-v3/model.zip --without-predictor 1 --episode 0``.
It needs Playwright (extra `dev`) and Chromium; software rendering suffices.
"""

from __future__ import annotations

import argparse
import base64
import io
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from PIL import Image
from tqdm import tqdm

from quad_swarm.evaluation.command import add_policy_arguments, make_conditions
from quad_swarm.evaluation.rows import check_writable
from quad_swarm.figures.replay import replay_page
from quad_swarm.world.presets import make_config
from studies.swarm.protocol import ROOT

THEMES = ("light", "dark")
# Duration of the last frame (s)
HOLD = 2.5
# WebGL without a graphics card
SOFTWARE_WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@contextmanager
def opened(page: str) -> Iterator[Any]:
    """Open a page in a headless Chromium, in its mode for scripts.

    :param page: HTML
    :return: a Playwright page, which evaluates JavaScript
    """
    from playwright.sync_api import sync_playwright  # only needed here

    with sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
        path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox", *SOFTWARE_WEBGL])
        file = Path(folder) / "replay.html"
        file.write_text(page, encoding="utf-8")
        tab = browser.new_page()
        tab.goto(f"{file.as_uri()}#hero")
        yield tab
        browser.close()


def frames(
    tab: Any, size: tuple[int, int], theme: str, fps: int, speed: float, until: float | None
) -> Iterator[Image.Image]:
    """Yield the frames of an animation.

    :param tab: see `opened`
    :param size: width and height (pixels)
    :param theme: light or dark
    :param fps: frames per second
    :param speed: seconds of the flight per second
    :param until: end of the animation in the flight (s), by default shortly after the last arrival
    """
    # Draw at twice the size and scale down to keep thin lines smooth
    duration = tab.evaluate("prepare", {"width": size[0], "height": size[1], "ratio": 2, "theme": theme})
    count = round((duration if until is None else until) / speed * fps) + 1
    for k in tqdm(range(count), desc=theme, leave=False):
        data = tab.evaluate("renderFrame", k / fps * speed)
        with Image.open(io.BytesIO(base64.b64decode(data.partition(",")[2]))) as picture:
            yield picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)


def save(path: Path, pictures: list[Image.Image], fps: int, quality: int) -> None:
    """Write an animation, WebP or GIF, that loops forever and pauses at its end."""
    durations = [1000 // fps] * (len(pictures) - 1) + [round(1000 * HOLD)]
    if path.suffix == ".gif":
        palette = pictures[len(pictures) // 2].quantize(255, dither=Image.Dither.NONE)
        pictures = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
        options: dict[str, Any] = {"optimize": True, "disposal": 1}
    else:
        options = {"quality": quality, "method": 4, "minimize_size": False, "kmax": 60}
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations, loop=0, **options)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_policy_arguments(parser)
    parser.add_argument("--scenario", default="symmetric_swap")
    parser.add_argument("--episode", type=int, default=0, help="index of the episode in the set (default 0)")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images", help="folder (default docs/images)")
    parser.add_argument("--name", default="hero", help="name of the files (default hero)")
    parser.add_argument("--format", nargs="+", choices=("webp", "gif"), default=["webp"])
    parser.add_argument("--size", type=int, nargs=2, default=(1080, 460), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--fps", type=int, default=20)
    parser.add_argument("--speed", type=float, default=0.5, help="speed of the flight (default 0.5: half of real time)")
    parser.add_argument("--seconds", type=float, help="seconds of the flight to show (default: until all have arrived)")
    parser.add_argument("--quality", type=int, default=70, help="quality of the WebP (default 70)")
    parser.add_argument("--without-predictor", type=int, default=0, metavar="N", help="number of policies (default 0)")
    args = parser.parse_args()
    conditions = [
        replace(one, config=make_config(one.config, {"predictor": None})) if number < args.without_predictor else one
        for number, one in enumerate(make_conditions(args, [args.scenario]))
    ]
    for theme in THEMES:
        check_writable(args.out / f"{args.name}-{theme}.webp", "--out")
    page = replay_page(conditions, args.seed, args.episode, args.preset)
    with opened(page) as tab:
        for theme in THEMES:
            pictures = list(frames(tab, tuple(args.size), theme, args.fps, args.speed, args.seconds))
            for suffix in args.format:
                path = args.out / f"{args.name}-{theme}.{suffix}"
                save(path, pictures, args.fps, args.quality)
                print(f"wrote {path}, {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
