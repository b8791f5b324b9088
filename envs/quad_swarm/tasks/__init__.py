"""Long work in pieces: processes that may die, and pieces that are kept until all is done."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

from quad_swarm.errors import unknown_name
from quad_swarm.tasks.cluster import Cluster
from quad_swarm.tasks.journal import Journal
from quad_swarm.tasks.pool import Pool

ENGINES = ("local", "ray")


def make_executor(
    engine: str, jobs: int, modules: Sequence[str] = (), address: str | None = None, mixed: bool = False
) -> Executor:
    """What works off pieces; all give the same results, to the last bit.

    :param engine: "local": processes of this machine, or "ray": see `Cluster`
    :param jobs: how many processes
    :param modules: imported by each of them first
    :param address: of a Ray cluster, see `Cluster`
    :param mixed: see `Cluster`
    :raises ValueError: unknown engine, or an address without Ray
    """
    if engine not in ENGINES:
        raise unknown_name("engine", engine, ENGINES)
    if engine == "ray":
        return Cluster(jobs, modules, address, mixed)
    if address is not None:
        raise ValueError(f"address={address!r} is for engine='ray'; processes of this machine need none.")
    return Pool(jobs, modules)


__all__ = ["ENGINES", "Cluster", "Journal", "Pool", "make_executor"]
