"""What may go wrong in the world: settings, all off by default. `Realisation` draws what comes of them.

Neither planner nor policy is told any of it; they see its consequences as far as a robot could.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field, NonNegativeFloat

from quad_swarm.validation import checked

# Beyond these nothing flies, and numbers lose their meaning before they overflow.
Disturbance = Annotated[float, Field(ge=0, le=1e3)]
Share = Annotated[float, Field(ge=0, le=1)]


@checked
@dataclass(frozen=True)
class ProcessNoise:
    """Disturbances of the flight itself.

    :param pos: standard deviation added to each position component in each step (m)
    :param vel: standard deviation added to each velocity component in each step (m/s)
    :param attitude: standard deviation added to roll and pitch in each step (rad)
    :param wind: speed of a steady horizontal wind whose direction is drawn for each episode (m/s)
    :param gust: standard deviation of each horizontal component of the gusts that each robot meets on top of that, a
        first-order Gauss-Markov process (m/s)
    :param gust_time: correlation time of the gusts (s)
    :raises ValueError: a value is negative, not finite, or beyond 1000 (pi for the attitude)
    """

    pos: Disturbance = 0.0
    vel: Disturbance = 0.0
    attitude: Annotated[float, Field(ge=0, le=math.pi)] = 0.0
    wind: Disturbance = 0.0
    gust: Disturbance = 0.0
    gust_time: NonNegativeFloat = 0.5

    def __bool__(self) -> bool:
        return any((self.pos, self.vel, self.attitude, self.wind, self.gust))


@checked
@dataclass(frozen=True)
class SensingError:
    """Errors of the estimated states, first-order Gauss-Markov processes with these standard deviations.

    A robot takes itself to be where its estimate says. The others see it there too, as from one motion capture system
    that tells everybody, each with an error of its own on top.

    :param pos: of each component of a robot's position (m)
    :param vel: of each component of its velocity (m/s)
    :param attitude: of its roll and pitch (rad)
    :param others_pos: of each component of another robot's position, different for each observer (m)
    :param others_vel: of each component of another robot's velocity, different for each observer (m/s)
    :param correlation_time: in which the errors are forgotten (s); 0 draws them anew in each step
    :raises ValueError: a value is negative, not finite, or beyond 1000 (pi for the attitude)
    """

    pos: Disturbance = 0.0
    vel: Disturbance = 0.0
    attitude: Annotated[float, Field(ge=0, le=math.pi)] = 0.0
    others_pos: Disturbance = 0.0
    others_vel: Disturbance = 0.0
    correlation_time: NonNegativeFloat = 0.2

    @property
    def own(self) -> bool:
        """Whether robots are wrong about themselves."""
        return any((self.pos, self.vel, self.attitude))

    @property
    def others(self) -> bool:
        """Whether observers are wrong, each in its own way, about others."""
        return any((self.others_pos, self.others_vel))

    def __bool__(self) -> bool:
        return self.own or self.others


@checked
@dataclass(frozen=True)
class Radio:
    """How plans travel. A request counts whether or not its answer arrives.

    :param loss: share of the answers that get lost, each for itself
    :param delay: steps by which answers are late: with 0 a robot receives the plan that was made one step ago
    :param jitter: further steps by which an answer is late, drawn evenly from 0 to this for each answer; of two plans
        the one that was made later is kept
    :param bursts: share of the time in which a link between two robots, in one direction, is interrupted
    :param burst_length: mean length of an interruption (steps)
    :param outage: share of the robots that stop answering for good, at a time drawn evenly from the first 5 s; they fly
        and ask on
    :raises ValueError: a share lies outside [0, 1] (bursts: below 1), a delay outside 0 to 1000, or a burst is shorter
        than a step
    """

    loss: Share = 0.0
    delay: Annotated[int, Field(ge=0, le=1000)] = 0
    jitter: Annotated[int, Field(ge=0, le=1000)] = 0
    bursts: Annotated[float, Field(ge=0, lt=1)] = 0.0
    burst_length: Annotated[float, Field(ge=1)] = 10.0
    outage: Share = 0.0

    @property
    def is_random(self) -> bool:
        """Whether it is left to chance what arrives, and when."""
        return any((self.loss, self.jitter, self.bursts, self.outage))
