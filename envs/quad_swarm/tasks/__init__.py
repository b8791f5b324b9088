"""Long work in pieces: processes that may die, and pieces that are kept until all is done."""

from quad_swarm.tasks.journal import Journal
from quad_swarm.tasks.pool import Pool

__all__ = ["Journal", "Pool"]
