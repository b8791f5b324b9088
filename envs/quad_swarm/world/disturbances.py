"""Settings of the disturbances, all off by default. `Realisation` draws random numbers accordingly.

Planners and policies do not know the disturbances. They only observe the consequences that a robot could observe.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, NonNegativeFloat

from quad_swarm.validation import PositiveLength, checked

# Limits far beyond any flight, and small enough for precise calculations
Disturbance = Annotated[float, Field(ge=0, le=1e3)]
Share = Annotated[float, Field(ge=0, le=1)]


def _check_interruptions(name: str, share: float, name_of_length: str, length: float) -> None:
    """Check that interruptions take a share of the time: there is a step between two of them."""
    if share > length / (length + 1):
        raise ValueError(
            f"{name}={share:g}: with a step between two of them, interruptions of {length:g} steps take at most "
            f"{length / (length + 1):.3g} of the time; raise {name_of_length} to at least {share / (1 - share):.3g}"
        )


@checked
@dataclass(frozen=True)
class ProcessNoise:
    """Disturbances of the flight itself.

    :param pos: standard deviation added to each position component in each step (m)
    :param vel: standard deviation added to each velocity component in each step (m/s)
    :param attitude: standard deviation added to roll and pitch in each step (rad)
    :param wind: speed of a constant horizontal wind whose direction is drawn for each episode (m/s)
    :param gust: standard deviation of each horizontal component of the additional gusts at each robot, first-order
        Gauss-Markov processes (m/s)
    :param gust_time: correlation time of the gusts (s)
    :raises ValueError: if a value is negative, not finite, or above 1000 (pi for the attitude)
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
    """Standard deviations of the errors of estimated states, which are first-order Gauss-Markov processes.

    The others observe a robot at its own estimate, as if one motion capture system served all robots, plus an
    additional error for each observer. What they observe may come late, and a robot may be lost from sight, as when
    markers are covered: meanwhile, it moves on at its last velocity in the eyes of all others. It does not know that,
    and keeps its own estimate.

    :param pos: error of each component of a robot's position (m)
    :param vel: error of each component of its velocity (m/s)
    :param attitude: error of its roll and pitch (rad)
    :param others_pos: additional error of each component of another robot's position, different for each observer (m)
    :param others_vel: additional error of each component of another robot's velocity, different for each observer (m/s)
    :param correlation_time: correlation time of the errors (s); 0 for white noise
    :param others_delay: age of what is observed of others (steps); observers know it, and move them on at their
        velocities
    :param gaps: fraction of the time in which a robot is lost, independently of other robots; at the start, none is
    :param gap_length: mean length of a gap (steps)
    :raises ValueError: if a value is negative, not finite, or above 1000 (pi for the attitude, below 1 for ``gaps``),
        or ``gap_length`` is less than a step, or too short for ``gaps``
    """

    pos: Disturbance = 0.0
    vel: Disturbance = 0.0
    attitude: Annotated[float, Field(ge=0, le=math.pi)] = 0.0
    others_pos: Disturbance = 0.0
    others_vel: Disturbance = 0.0
    correlation_time: NonNegativeFloat = 0.2
    others_delay: Annotated[int, Field(ge=0, le=1000)] = 0
    gaps: Annotated[float, Field(ge=0, lt=1)] = 0.0
    gap_length: Annotated[float, Field(ge=1)] = 10.0

    def __post_init__(self) -> None:
        _check_interruptions("sensing.gaps", self.gaps, "sensing.gap_length", self.gap_length)

    @functools.cached_property
    def own(self) -> bool:
        """Whether robots' estimates of their own states have errors."""
        return any((self.pos, self.vel, self.attitude))

    @functools.cached_property
    def others(self) -> bool:
        """Whether observers have additional errors about others."""
        return any((self.others_pos, self.others_vel))

    @functools.cached_property
    def tracks(self) -> bool:
        """Whether what others observe of a robot may be late or lost."""
        return bool(self.others_delay or self.gaps)

    def __bool__(self) -> bool:
        return self.own or self.others or self.tracks


@checked
@dataclass(frozen=True)
class Radio:
    """Transmission of plans. A request counts whether or not its answer arrives.

    By default, an answer is used in the step of its request and is older by its delay, which is simple but not causal:
    its sender must have known of the request when it made the plan. With ``round_trip``, the answer is the plan of the
    last step, as of the request, and is used later, as in a network.

    What distance does is drawn once in a step for each exchange: a request and its answer, even one that comes steps
    later, or an announcement. Either the radio carries all of it or nothing, as radio channels are reciprocal and
    hardly change while a robot answers. What counts is the true distance at the request, which robots do not know: a
    robot that is not reached does not know that it was asked, and who announces a plan assumes that it arrives.

    :param loss: probability that an answer is lost, independently for each answer, at any distance
    :param delay: delay of answers (steps); with 0 a robot receives the plan that was made one step ago
    :param jitter: maximum additional delay (steps), drawn uniformly from 0 to this for each answer; robots keep the
        newer of two plans
    :param round_trip: steps from a request to the use of its answer, apart from jitter; 0 if robots wait for answers
        within a step; None for answers that are used at once and are older, by ``delay``
    :param range: distance beyond which nothing is carried (m), as ``MaxRange`` of ns-3's ``RangePropagationLossModel``;
        None for any distance
    :param half_distance: distance at which half of the exchanges fail (m), see `carries`; None if none fails within the
        range
    :param path_loss_exponent: exponent n with which the power received falls with distance: 2 in free space, 3 in
        ns-3's ``LogDistancePropagationLossModel``; only with ``half_distance``
    :param bursts: fraction of the time in which the link from one robot to another is interrupted
    :param burst_length: mean length of an interruption (steps)
    :param outage: probability that a robot stops answering for good, at a time drawn uniformly from the first 5 s; it
        still flies and makes requests
    :raises ValueError: if a probability is outside [0, 1] (``bursts``: [0, 1)), a delay is outside 0 to 1000,
        ``burst_length`` is less than a step or too short for ``bursts``, a distance is not positive,
        ``path_loss_exponent`` is outside 1 to 10, or there are both ``delay`` and ``round_trip``
    """

    loss: Share = 0.0
    delay: Annotated[int, Field(ge=0, le=1000)] = 0
    jitter: Annotated[int, Field(ge=0, le=1000)] = 0
    bursts: Annotated[float, Field(ge=0, lt=1)] = 0.0
    burst_length: Annotated[float, Field(ge=1)] = 10.0
    outage: Share = 0.0
    round_trip: Annotated[int, Field(ge=0, le=1000)] | None = None
    range: PositiveLength | None = None
    half_distance: PositiveLength | None = None
    path_loss_exponent: Annotated[float, Field(ge=1, le=10)] = 3.0

    def __post_init__(self) -> None:
        _check_interruptions("radio.bursts", self.bursts, "radio.burst_length", self.burst_length)
        if self.round_trip is not None and self.delay:
            raise ValueError(
                f"radio.round_trip={self.round_trip} and radio.delay={self.delay} both say when answers count: give "
                "radio.round_trip alone (steps from a request to its answer), or set radio.round_trip=null (answers "
                "hold plans that are radio.delay steps old)"
            )

    @functools.cached_property
    def is_random(self) -> bool:
        """Whether it is random which answers arrive, and when."""
        return any((self.loss, self.jitter, self.bursts, self.outage, self.half_distance))

    @property
    def limits_distance(self) -> bool:
        """Whether it depends on distance what arrives."""
        return self.range is not None or self.half_distance is not None

    def carries(self, distance: np.ndarray) -> np.ndarray:
        """Return the probability that the radio carries an exchange: ``2 ** -(d / half_distance) ** n`` at the distance
        d up to ``range``, 0 beyond.

        This is the share that arrives if power falls as in the log-distance model, Rayleigh fading is drawn for each
        exchange, and a receiver needs a certain power (outage probability in A. Goldsmith, *Wireless Communications*,
        2005). In ns-3: ``LogDistancePropagationLossModel``, then ``NakagamiPropagationLossModel`` with m = 1.

        :param distance: distances, (...) (m)
        """
        carried = np.ones_like(distance)
        if self.half_distance is not None:
            with np.errstate(over="ignore"):  # so far away that nothing arrives
                carried = np.exp2(-((distance / self.half_distance) ** self.path_loss_exponent))
        return carried if self.range is None else np.where(distance <= self.range, carried, 0.0)
