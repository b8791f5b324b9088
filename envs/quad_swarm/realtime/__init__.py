"""Robots in real time: links, the loop, its supervisor, and simulated vehicles to try them on.

Imports what `quad_swarm.robot` does, neither PyTorch nor Gymnasium.
"""

from quad_swarm.realtime.link import Channel, Conditions, Handler, Link, Sensed, Vehicle, WireLink, session_of
from quad_swarm.realtime.loop import Loop
from quad_swarm.realtime.supervisor import Mode, SafetyLimits, Supervisor, Watchdog

__all__ = [
    "Channel",
    "Conditions",
    "Handler",
    "Link",
    "Loop",
    "Mode",
    "SafetyLimits",
    "Sensed",
    "Supervisor",
    "Vehicle",
    "Watchdog",
    "WireLink",
    "session_of",
]
