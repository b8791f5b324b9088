"""A node whose messages a loop takes when it waits for them."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from quad_swarm.errors import shown, unknown_name
from quad_swarm.realtime.link import Handler, monotonic
from quad_swarm.robot import Plan
from quad_swarm.world.presets import SwarmConfig

# Wheels name no middleware, and nothing shall leave this machine unless the user says so
DEFAULTS = {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
_OF_ROS = ("use_sim_time", "start_type_description_service", "qos_overrides")
Take = Callable[[Any, Any], None]


def quality(depth: int, reliable: bool = False, lasting: bool = False) -> Any:
    """Return the quality of service of a topic: best effort, since what is lost is out of date when it is sent again.

    :param depth: messages that wait for their receiver; one of plans would lose answers that arrive together
    :param reliable: reliable instead: publishers for foreign subscribers, which may require it, and with some
        middlewares do so by default; such a publisher also reaches those who do not
    :param lasting: reliable, and also for those who come later
    """
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE if reliable or lasting else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if lasting else DurabilityPolicy.VOLATILE,
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
    )


def make_context(args: Sequence[str] | None = None) -> Any:
    """Create a context, which nodes live in.

    :param args: command line, of which those after ``--ros-args`` count; none by default
    :raises ImportError: if ROS 2 is not there
    :raises ValueError: if the arguments of ROS are wrong
    """
    for key, value in DEFAULTS.items():
        os.environ.setdefault(key, value)
    try:
        import rclpy
    except ImportError:
        raise ImportError(
            "ROS 2 is not there: source a distribution's setup.bash, or on x86-64, in the clone, "
            "pip install -e '.[ros]'."
        ) from None
    context = rclpy.Context()
    try:
        rclpy.init(args=list(args or ()), context=context)
    except RuntimeError as error:
        raise ValueError(f"the arguments of ROS are wrong: {error}") from None
    return context


def make_node(name: str, namespace: str = "", context: Any = None) -> Any:
    """Create a node.

    :param name: its name
    :param namespace: its namespace
    :param context: context to create it in, by default one of its own
    :raises ImportError: if ROS 2 is not there
    """
    context = make_context() if context is None else context
    import rclpy

    options: Any = {"start_parameter_services": False, "enable_rosout": False}
    return rclpy.create_node(name, namespace=namespace, context=context, **options)


def declare(node: Any, defaults: Mapping[str, Any]) -> None:
    """Declare parameters of any type: whoever reads them checks them, and can say what is wrong.

    :param node: the node
    :param defaults: what they are if nobody sets them, by name
    """
    from rcl_interfaces.msg import ParameterDescriptor

    for name, value in defaults.items():
        node.declare_parameter(name, value, ParameterDescriptor(dynamic_typing=True))


def values_of(node: Any, defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of parameters by name. An empty list has no type, so ROS takes it for none at all.

    :param node: the node
    :param defaults: what was given to `declare`
    :raises ValueError: if somebody set a parameter that there is not, or simulated time
    """
    # rclpy does not tell what was set and never declared: a misspelt name would be ignored
    for name in getattr(node, "_parameter_overrides", {}):
        if name not in defaults and name.partition(".")[0] not in _OF_ROS:
            raise unknown_name("parameter", name, defaults)
    if node.has_parameter("use_sim_time") and node.get_parameter("use_sim_time").value:
        raise ValueError("use_sim_time=True: robots fly in real time here, so leave it out")
    values = {name: node.get_parameter(name).value for name in defaults}
    return {name: defaults[name] if value is None else value for name, value in values.items()}


def texts(name: str, value: Any) -> list[str]:
    """Return a parameter that is a list of texts.

    :param name: its name
    :param value: its value
    :raises ValueError: if it is none
    """
    values: list[Any] = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [None]
    if not all(isinstance(one, str) for one in values):
        raise ValueError(f"{name}={shown(value)}: give a list of texts, as in {name}:=[a,b]")
    return values


def numbers(name: str, value: Any, width: int) -> np.ndarray:
    """Return a parameter that is a list of finite numbers, as rows, (k, width).

    :param name: its name
    :param value: its value
    :param width: how many make a row
    :raises ValueError: if it is none, or a row is not complete
    """
    values: list[Any] = list(value) if np.iterable(value) and not isinstance(value, str) else [None]
    if len(values) % width or not all(type(one) in (int, float) and np.isfinite(one) for one in values):
        what = "a finite number" if width == 1 else f"finite numbers, {width} for each point"
        raise ValueError(f"{name}={shown(value[0] if width == 1 else value)}: give {what}")
    return np.array(values, float).reshape(-1, width)


def checked_names(value: Any) -> list[str]:
    """Return the names of all robots, from the parameter ``names``.

    :raises ValueError: if they are not two or more different names
    """
    names = texts("names", value)
    if len(names) < 2 or len(set(names)) < len(names):
        raise ValueError(f"names={shown(names)}: give the names of all robots, two or more, each once")
    if wrong := [name for name in names if re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) is None]:
        raise ValueError(f"names: {shown(wrong[0])} is no name: use letters, digits and underscores, a letter first")
    return names


def standing(config: SwarmConfig) -> None:
    """Check that the obstacles of a world stand, since nodes start at different times.

    :raises ValueError: if one moves
    """
    for k, obstacle in enumerate(config.obstacles.listed):
        if obstacle.moves:
            raise ValueError(
                f"obstacles.listed[{k}].velocity={obstacle.velocity}: nodes that start at different times do not agree "
                "where it is; leave out obstacles that move"
            )


def make_executor(context: Any) -> Any:
    """Return an executor for nodes of a context. The default one asks all subscriptions at each message: plans take
    about 15 times as long with it."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:  # before Jazzy
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def leave() -> NoReturn:
    """End the process now. Python would take ROS apart at its end, and may wait for ever for threads of the middleware
    that wait for Python."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


class Nobody:
    """A handler of those who have no plans."""

    def on_request(self, sender: int) -> None:
        """See `Handler`."""

    def on_plan(self, sender: int, plan: Plan, sent: int | None, period: int) -> None:
        """See `Handler`."""


class Mailbox:
    """Receives the messages of a node while a loop waits for them, and only then.

    :param node: the node
    """

    def __init__(self, node: Any):
        self._node = node
        self._handler: Any = None
        self._silent: Any = None  # a node without an executor, which would be woken by each message
        self._executor = make_executor(node.context)
        self._executor.add_node(node)

    def subscribe(self, kind: type, topic: str, profile: Any, take: Take, raw: bool = False) -> None:
        """Receive a topic.

        :param kind: class of its messages
        :param topic: its name
        :param profile: its quality of service
        :param take: what to do with a message, given the handler of `wait`, too
        :param raw: whether to take its bytes
        """

        def hand_over(message: Any) -> None:
            take(message, self._handler)

        self._node.create_subscription(kind, topic, hand_over, profile, raw=raw)

    def newest(self, kind: type, topic: str, raw: bool = False) -> Callable[[], Any]:
        """Receive a topic of which only the newest message counts. Nothing happens when messages come.

        :param kind: class of its messages
        :param topic: its name
        :param raw: whether to take its bytes
        :return: takes the newest message, None if none has come since
        """
        if self._silent is None:
            name = f"{self._node.get_name()}_senses"
            self._silent = make_node(name, self._node.get_namespace(), self._node.context)
        subscription = self._silent.create_subscription(kind, topic, lambda message: None, quality(1))

        def take() -> Any:
            with subscription.handle:
                taken = subscription.handle.take_message(kind, raw)
            return None if taken is None else taken[0]

        return take

    def entities(self) -> list[tuple[Callable[[Any], Any], Any]]:
        """Return what the node publishes, receives and offers, each with what destroys it."""
        kinds, nodes = ("publisher", "subscription", "service"), [self._node, *filter(None, [self._silent])]
        every = ((kind, node, one) for node in nodes for kind in kinds for one in getattr(node, f"{kind}s"))
        return [(getattr(node, f"destroy_{kind}"), one) for kind, node, one in every]

    def wait(self, until: int, handler: Handler, done: Callable[[], bool] = lambda: False) -> None:
        """See `quad_swarm.realtime.Link`."""
        self._handler = handler
        while True:
            left = max(until - monotonic(), 0)
            self._executor.spin_once(timeout_sec=left * 1e-6)
            if left == 0 or done():
                return

    def close(self) -> None:
        """Stop receiving, and end the node."""
        self._executor.shutdown()
        for node in filter(None, [self._silent, self._node]):
            node.destroy_node()
        self._node.context.try_shutdown()
