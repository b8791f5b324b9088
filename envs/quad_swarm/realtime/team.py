"""What all robots of a flight have in common, as a file that their processes read."""

from __future__ import annotations

import dataclasses
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from quad_swarm.errors import shown
from quad_swarm.planner import base
from quad_swarm.realtime.link import Conditions
from quad_swarm.realtime.loop import check_times
from quad_swarm.realtime.supervisor import SafetyLimits
from quad_swarm.realtime.udp import check_group
from quad_swarm.robot import Robot, RulePolicy, files
from quad_swarm.validation import checked
from quad_swarm.world.presets import SwarmConfig, first_difference

_MOST_BYTES = 2**20


@checked
@dataclass(frozen=True)
class Team:
    """Robots that fly together.

    :param config: the world
    :param policy: a rule, or the folder of an exported model
    :param limits: when robots hover and land
    :param wait: see `quad_swarm.realtime.Loop` (s)
    :param late: see `quad_swarm.realtime.Loop` (periods)
    :param session: see `quad_swarm.realtime.WireLink`
    :param checked: see `quad_swarm.realtime.WireLink`
    :param group: address and port of a multicast group; None to send to each robot's own
    :param conditions: how messages fare, for trials
    :param priority: real-time priority (SCHED_FIFO) of the robots' processes, 1 to 99; 0 for none
    :param clock_errors: errors of the robots' clocks (s), for trials; none if empty
    :raises ValueError: if a value is out of range, or the policy does not fit the world
    """

    config: SwarmConfig
    policy: str
    limits: SafetyLimits = field(default_factory=SafetyLimits)
    wait: Annotated[float, Field(ge=0)] = 0.005
    late: Annotated[float, Field(ge=0, lt=1)] = 0.25
    session: Annotated[int, Field(ge=0, le=255)] = 0
    checked: bool = False
    group: tuple[str, Annotated[int, Field(ge=1, le=65535)]] | None = None
    conditions: Conditions = field(default_factory=Conditions)
    priority: Annotated[int, Field(ge=0, le=99)] = 0
    clock_errors: tuple[Annotated[float, Field(ge=-10, le=10)], ...] = ()

    def __post_init__(self) -> None:
        check_times(self.wait, self.late, self.config.planner.dt)
        if self.group is not None:
            check_group(self.group[0])
        if self.clock_errors and len(self.clock_errors) != self.config.n_robots:
            raise ValueError(f"clock_errors={self.clock_errors}: there are {self.config.n_robots} robots")
        if self.is_learned:
            exported = files.load(self.policy).config
            # Robots know neither the plant nor how far vehicles are from their model
            known: dict[str, Any] = {"plant": self.config.plant, "mismatch": self.config.mismatch}
            if dataclasses.replace(exported, **known) != self.config:
                raise ValueError(f"{self.policy} was exported for another world: {_difference(exported, self.config)}")
        else:
            try:
                RulePolicy(self.policy)
            except ValueError as error:
                if os.path.exists(self.policy):
                    raise ValueError(
                        f"{shown(self.policy)} is no folder that `sb3-maddpg export` wrote, which holds "
                        f"{files.DESCRIPTION}, and no rule ({error})"
                    ) from None
                raise ValueError(f"{error} There is no folder of that name either.") from None

    @property
    def is_learned(self) -> bool:
        """Whether the policy is the folder of a model."""
        return (Path(self.policy) / files.DESCRIPTION).is_file()

    def robot(self, index: int, planner: base.Planner | None = None) -> Robot:
        """Create one of the robots."""
        if not self.is_learned:
            return Robot(self.config, index, RulePolicy(self.policy, [self.session, index]), planner)
        return files.load(self.policy).robot(index, planner)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the team as JSON."""
        content = dataclasses.asdict(self)
        Path(path).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def load(path: str | os.PathLike[str]) -> Team:
    """Read a team that `Team.write` wrote.

    :raises ValueError: if the file describes no team
    """
    path = Path(path)
    if path.stat().st_size > _MOST_BYTES:
        raise ValueError(f"{path} is larger than {_MOST_BYTES} bytes, so it describes no team.")
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
        known = {one.name for one in dataclasses.fields(Team)}
        if not isinstance(content, dict) or content.keys() - known or not {"config", "policy"} <= content.keys():
            raise ValueError(f"a team has the fields {', '.join(sorted(known))}, of which config and policy are needed")
        return Team(**content)
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} describes no team: {shown(str(error))}.") from None


def _difference(exported: Any, config: Any) -> str:
    """Say in which field two worlds differ first, and what to do."""
    found = first_difference(exported, config, ("plant", "mismatch"))
    assert found is not None
    name, old, new = found
    given = "--n-robots {}" if name == "n_robots" else f"--world {name}={{}}"
    return (
        f"for {name}={old}, and this one has {new}; fly it as it was exported, with {given.format(old)}, or write "
        f"it for this one with `sb3-maddpg export ... {given.format(new)}`"
    )
