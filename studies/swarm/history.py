"""Would robots know better whom to tell if they remembered? For docs/anticipation.md.

``python -m studies.swarm.history [--frames K ...] [--lessons N] [--updates N] [--preset P] [--seed S] [--json F]``
learns which plans change others' plans, as `studies.swarm.information` does, from what robots observe now (one frame)
and from the last frames, each a step older, by the same network with more inputs. It prints how well held-out flights
are told, and so what a recurrent actor could gain from so much of the past. JSON: one row per number of frames.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional as F

from quad_swarm.evaluation.rows import write_rows
from sb3_maddpg.common.layout import NeighbourViews
from sb3_maddpg.relational.networks import PairActor, PairNet
from studies.swarm.experiment import Row
from studies.swarm.information import APART, SWARMS, School, beginner, parsed

BATCH = 24


class Film(NamedTuple):
    """What robots saw in some steps, the newest first, and which plans mattered in the newest.

    :param frames: observations, (APART + 1, E, n, size)
    :param asked: whether to ask each of the others, and whether to tell it, (E, n, n - 1, 2) bool
    """

    frames: np.ndarray
    asked: np.ndarray


def film(school: School) -> Film:
    """Fly some steps as the rule sends, then look. Before an episode's first step, robots saw what they saw then."""
    lesson = school.lesson(None)
    frames = [lesson.obs]
    for age, obs in enumerate(reversed(school.seen), 1):
        began = (school.age < age)[:, None, None]
        frames.append(np.where(began, frames[-1], obs))
    return Film(np.stack(frames), lesson.asked.reshape(*lesson.asked.shape[:2], -1, 2))


class Remembering(nn.Module):
    """The actor of a PairPolicy that reads several frames.

    :param views: splits observations
    :param frames: number of frames
    """

    def __init__(self, views: NeighbourViews, frames: int):
        super().__init__()
        self.views, self.frames = views, frames
        own, of_one = views.own_dim * frames, (views.own_dim + views.neighbour_dim) * frames
        self.net = PairNet(of_one, [own], 2, [64, 64], nn.ReLU)

    def forward(self, frames: th.Tensor) -> th.Tensor:
        """:return: logits of asking and telling, (batch, n, n - 1, 2)"""
        seen = [self.views(obs)[:2] for obs in frames[: self.frames]]
        own, neighbours = (th.cat(parts, dim=-1) for parts in zip(*seen, strict=True))
        each = own.unsqueeze(-2).expand(*neighbours.shape[:-1], -1)
        hidden, _ = self.net.encode(th.cat([each, neighbours], dim=-1), None)
        return self.net.head(hidden.add_(self.net.extra(0, own).unsqueeze(-2)))


def precision_of(scores: np.ndarray, matters: np.ndarray) -> float:
    """Return the average precision of scores: the mean share of plans that matter among those of a higher score."""
    order = np.argsort(-scores, kind="stable")
    hits = matters[order]
    return float((np.cumsum(hits) / np.arange(1, len(hits) + 1))[hits].mean())


def learn(films: Sequence[Film], held: Sequence[Film], views: NeighbourViews, frames: int, updates: int) -> Row:
    """Learn from some films, then tell the others."""
    net, started = Remembering(views, frames), time.perf_counter()
    optimizer = th.optim.Adam(net.parameters(), lr=1e-3)
    rng = np.random.default_rng(0)
    assert views.mask is not None
    for k in range(updates):
        for group in optimizer.param_groups:
            group["lr"] = 1e-3 * (1 - k / updates)
        one = films[int(rng.integers(len(films)))]
        chosen = rng.permutation(SWARMS)[:BATCH]
        obs, asked = th.as_tensor(one.frames[:, chosen]), th.as_tensor(one.asked[chosen])
        may = views.mask(obs[0]).squeeze(-1) > 0
        loss = F.binary_cross_entropy_with_logits(net(obs)[may], asked[may].float())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    logits, matters = [], []
    with th.no_grad():
        for one in held:
            obs = th.as_tensor(one.frames)
            may = views.mask(obs[0]).squeeze(-1) > 0
            logits.append(net(obs)[may].flatten())
            matters.append(th.as_tensor(one.asked)[may].flatten())
    told, true = th.cat(logits), th.cat(matters)
    loss = F.binary_cross_entropy_with_logits(told, true.float())
    return {
        "frames": frames,
        "loss": float(loss),
        "average_precision": precision_of(told.numpy(), true.numpy()),
        "pairs": len(true),
        "matter": float(true.float().mean()),
        "seconds": time.perf_counter() - started,
    }


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[1, 2, APART + 1], choices=range(1, APART + 2))
    parser.add_argument("--lessons", type=int, default=300, help="looks; a fifth is held out (default %(default)s)")
    parser.add_argument("--updates", type=int, default=8000, help="updates (default %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parsed(parser)
    if options.lessons < 2:
        parser.error(f"argument --lessons: {options.lessons}: at least 2, one to learn from and one held out")
    model, kwargs = beginner(options)
    views = cast("PairActor", model.actor).views
    school = School(kwargs, options.target, options.seed)
    films = [film(school) for _ in range(options.lessons)]
    n_held = max(options.lessons // 5, 1)
    rows = []
    for frames in options.frames:
        th.manual_seed(options.seed)
        row = learn(films[:-n_held], films[-n_held:], views, frames, options.updates)
        rows.append(row)
        print(
            f"{frames} frames: loss {row['loss']:.5f}, average precision {row['average_precision']:.3f}, "
            f"{row['matter']:.2%} of {row['pairs']} matter, {row['seconds']:.0f} s",
            flush=True,
        )
    if options.json:
        write_rows(options.json, rows)


if __name__ == "__main__":
    main()
