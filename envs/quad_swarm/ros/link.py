"""A link over ROS 2. Each robot has two inboxes, so that nobody receives what is not for them.

============================= ==================================== ===========================================
topic                         type                                 content
============================= ==================================== ===========================================
``/NAME/plan_requests``       std_msgs/Header                      who asks (frame_id), and when
``/NAME/plans``               trajectory_msgs/                     whose plan (joint_names), from when on, and
                              MultiDOFJointTrajectory              its positions and velocities
============================= ==================================== ===========================================

Both are best effort. A request is no service: those are reliable, block, and repeat what is out of date.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from quad_swarm.realtime.link import BaseLink, Handler
from quad_swarm.robot import Plan
from quad_swarm.ros.messages import SerialisedPlans, from_trajectory, msgs, to_time
from quad_swarm.ros.node import Mailbox, quality


class RosLink(BaseLink):
    """A link over ROS 2.

    :param node: the robot's node
    :param mailbox: receives for it
    :param index: number of the robot
    :param names: names of all robots, their namespaces
    """

    def __init__(self, node: Any, mailbox: Mailbox, index: int, names: Sequence[str]):
        super().__init__(index)
        self._mailbox, self._names = mailbox, list(names)
        self._numbers = {name: number for number, name in enumerate(names)}
        header, trajectory, depth = msgs().Header, msgs().MultiDOFJointTrajectory, max(len(names), 2)
        others = [number for number in range(len(names)) if number != index]
        self._requests, self._plans = (
            {k: node.create_publisher(kind, f"/{names[k]}/{topic}", quality(depth)) for k in others}
            for kind, topic in ((header, "plan_requests"), (trajectory, "plans"))
        )
        mailbox.subscribe(header, f"/{names[index]}/plan_requests", quality(depth), self._take_request)
        mailbox.subscribe(trajectory, f"/{names[index]}/plans", quality(depth), self._take_plan, raw=True)
        self._writer: tuple[tuple[int, int], SerialisedPlans] | None = None
        self._readers: dict[str, tuple[int, SerialisedPlans]] = {}

    def absent(self) -> list[str]:
        """Return the names of the robots that do not receive requests, as far as discovery knows."""
        return [self._names[k] for k, publisher in self._requests.items() if not publisher.get_subscription_count()]

    def request(self, other: int) -> None:
        """See `Link`."""
        self.traffic.requests += 1
        from rclpy.serialization import serialize_message

        stamp = to_time(self.shared(self.now()))
        header = msgs().Header(frame_id=self._names[self.index], stamp=stamp)
        self._publish(self._requests[other], serialize_message(header))

    def send(self, other: int, plan: Plan, period: int, asked: bool) -> None:
        """See `Link`."""
        if asked:
            self.traffic.answers += 1
        else:
            self.traffic.announcements += 1
        told, form = plan._replace(stamp=self.shared(plan.stamp)), (len(plan.positions), period)
        if self._writer is None or self._writer[0] != form:
            self._writer = form, SerialisedPlans(self._names[self.index], *form)
        self._publish(self._plans[other], self._writer[1].write(told))

    def wait(self, until: int, handler: Handler, done: Callable[[], bool] = lambda: False) -> None:
        """See `Link`."""
        self._mailbox.wait(until, handler, done)

    def _publish(self, publisher: Any, data: bytes) -> None:
        self.traffic.bytes += len(data)
        publisher.publish(data)

    def _take_request(self, message: Any, handler: Handler) -> None:
        for one in [message] if self.channel is None else self.channel.arriving(message):
            sender = self._sender(one.frame_id)
            if sender is not None:
                handler.on_request(sender)

    def _take_plan(self, data: bytes, handler: Handler) -> None:
        # What does the work of a channel here only loses, repeats and delays: the middleware checks messages
        for one in [data] if self.channel is None else self.channel.arriving(bytearray(data)):
            try:
                name, plan, period = self._read(bytes(one))
            except Exception:  # whatever a foreign message, or the middleware, raises
                self.traffic.refused += 1
                continue
            sender = self._sender(name)
            if sender is not None:
                handler.on_plan(sender, plan._replace(stamp=self.own(plan.stamp)), None, period)

    def _read(self, data: bytes) -> tuple[str, Plan, int]:
        """Return sender, plan and length of its stages (us) of a message.

        :raises ValueError: if it is no plan
        """
        for name, (period, reader) in self._readers.items():
            if (plan := reader.read(data)) is not None:
                return name, plan, period
        from rclpy.serialization import deserialize_message

        name, plan, period = from_trajectory(deserialize_message(data, msgs().MultiDOFJointTrajectory))
        if name in self._numbers:
            self._readers[name] = period, SerialisedPlans(name, len(plan.positions), period)
        return name, plan, period

    def _sender(self, name: str) -> int | None:
        """Return the number of a sender that is heard."""
        sender = self._numbers.get(name)
        if sender is None:
            self.traffic.refused += 1
        elif sender in self.deaf_to:
            sender = None
        else:
            self.traffic.received += 1
        return sender
