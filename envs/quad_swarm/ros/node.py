"""A node whose messages a loop takes when it waits for them."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from quad_swarm.realtime.link import Handler, monotonic

# Wheels name no middleware, and nothing shall leave this machine unless the user says so
DEFAULTS = {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
Take = Callable[[Any, Any], None]


def quality(depth: int, lasting: bool = False) -> Any:
    """Return the quality of service of a topic: best effort, since what is lost is out of date when it is sent again.

    :param depth: messages that wait for their receiver; one of plans would lose answers that arrive together
    :param lasting: reliable instead, also for those who come later
    """
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE if lasting else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if lasting else DurabilityPolicy.VOLATILE,
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
    )


def make_node(name: str, namespace: str = "", context: Any = None) -> Any:
    """Create a node.

    :param name: its name
    :param namespace: its namespace
    :param context: context to create it in, by default one of its own
    :raises ImportError: if ROS 2 is not there
    """
    for key, value in DEFAULTS.items():
        os.environ.setdefault(key, value)
    try:
        import rclpy
    except ImportError:
        raise ImportError(
            "ROS 2 is not there: source a distribution's setup.bash, or pip install 'sb3-maddpg[ros]' on x86-64."
        ) from None
    if context is None:
        context = rclpy.Context()
        rclpy.init(context=context)
    options: Any = {"start_parameter_services": False, "enable_rosout": False}
    return rclpy.create_node(name, namespace=namespace, context=context, **options)


def make_executor(context: Any) -> Any:
    """Return an executor for nodes of a context. The default one asks all subscriptions at each message: plans take
    about 15 times as long with it."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:  # before Jazzy
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


class Mailbox:
    """Receives the messages of a node while a loop waits for them, and only then.

    :param node: the node
    """

    def __init__(self, node: Any):
        self._node = node
        self._handler: Any = None
        self._executor = make_executor(node.context)
        self._executor.add_node(node)

    def subscribe(self, kind: type, topic: str, profile: Any, take: Take) -> None:
        """Receive a topic.

        :param kind: class of its messages
        :param topic: its name
        :param profile: its quality of service
        :param take: what to do with a message, given the handler of `wait`, too
        """

        def hand_over(message: Any) -> None:
            take(message, self._handler)

        self._node.create_subscription(kind, topic, hand_over, profile)

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
        self._node.destroy_node()
        self._node.context.try_shutdown()
