"""Long work in pieces: executors that survive the death of processes, and a journal of finished pieces."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

from quad_swarm.errors import unknown_name
from quad_swarm.jobs.cluster import Cluster
from quad_swarm.jobs.journal import Journal
from quad_swarm.jobs.pool import Pool

ENGINES = ("local", "ray")


def make_executor(
    engine: str, jobs: int, modules: Sequence[str] = (), address: str | None = None, mixed: bool = False
) -> Executor:
    """Create an executor. All executors give bit-identical results.

    :param engine: "local" for processes of this machine, or "ray", see `Cluster`
    :param jobs: number of processes
    :param modules: modules that each process imports first
    :param address: address of a Ray cluster, see `Cluster`
    :param mixed: see `Cluster`
    :raises ValueError: if the engine is unknown, or there is an address without Ray
    """
    if engine not in ENGINES:
        raise unknown_name("engine", engine, ENGINES)
    if engine == "ray":
        return Cluster(jobs, modules, address, mixed)
    if address is not None:
        raise ValueError(f"address={address!r} is for engine='ray' only; leave it out.")
    return Pool(jobs, modules)


__all__ = ["ENGINES", "Cluster", "Journal", "Pool", "make_executor"]
