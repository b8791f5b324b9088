"""The robots' nodes and the simulated world's over ROS 2, without `ros2 launch`: processes, lifecycle services, goals.

Each robot is a lifecycle node in a process of its own. `Operator` starts them, takes them through their states and
sends goals, as `ros2 lifecycle set /robot_0/robot configure` and `ros2 topic pub /robot_0/goal_pose` do; replace the
world's node by your vehicles. Here robots exchange their places two by two, and land.
"""

import argparse
import json
import subprocess
import sys
import time

import numpy as np

from quad_swarm.ros.messages import from_odometry, msgs
from quad_swarm.ros.node import make_executor, make_node, quality

MOST = 500  # s to wait for anything


class Operator:
    """Starts nodes as processes, and talks to them. Use it as a context, which ends the processes.

    :param names: names of the robots
    """

    def __init__(self, names):
        self.names, self.processes, self.status, self.position = list(names), {}, {}, {}
        self.node = make_node("operator")
        self.executor = make_executor(self.node.context)
        self.executor.add_node(self.node)
        self.clients, self.goals = {}, {}
        for name in ["world", *self.names]:

            def keep(message, name=name):
                (one,) = message.status
                self.status[name] = {"message": one.message, **{pair.key: pair.value for pair in one.values}}

            topic = "/world/status" if name == "world" else f"/{name}/robot/status"
            self.node.create_subscription(msgs().DiagnosticArray, topic, keep, quality(5, reliable=True))
        for name in self.names:

            def see(message, name=name):
                self.position[name] = from_odometry(message)[1][:3]

            self.node.create_subscription(msgs().Odometry, f"/{name}/odom", see, quality(1))
            self.goals[name] = self.node.create_publisher(msgs().PoseStamped, f"/{name}/goal_pose", 10)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        # Robots land first, in the world that they still perceive
        for names in (self.processes.keys() - {"world"}, self.processes.keys() & {"world"}):
            for name in names:
                self.processes[name].terminate()
            for name in names:
                self.processes[name].wait()
        self.executor.shutdown()
        self.node.destroy_node()
        self.node.context.try_shutdown()

    def start_world(self, **parameters):
        """Start the simulated world."""
        self._start("world", "quad_swarm.ros.plant_node", {"names": self.names, **parameters})

    def start_robot(self, name, stderr=None, **parameters):
        """Start a robot's node, unconfigured."""
        words = {"names": self.names, "index": self.names.index(name), **parameters}
        self._start(name, "quad_swarm.ros.robot_node", words, ("-r", f"__ns:=/{name}"), stderr)

    def call(self, kind, service, **request):
        """Call a service, and return its answer."""
        if service not in self.clients:
            self.clients[service] = self.node.create_client(kind, service)
        client = self.clients[service]
        self.wait(client.service_is_ready)
        future = client.call_async(kind.Request(**request))
        self.wait(future.done)
        return future.result()

    def change(self, name, transition):
        """Take a robot's node through a transition, such as "configure". Return whether it succeeded."""
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState

        number = getattr(Transition, f"TRANSITION_{transition.upper()}")
        return self.call(ChangeState, f"/{name}/robot/change_state", transition=Transition(id=number)).success

    def state(self, name):
        """Return the state of a robot's node, such as "inactive"."""
        from lifecycle_msgs.srv import GetState

        return self.call(GetState, f"/{name}/robot/get_state").current_state.label

    def told(self, name, key):
        """Return what the last status of a robot or the world says, or None if there has been none yet."""
        return self.status.get(name, {}).get(key)

    def trigger(self, service):
        """Call a service such as "/robot_0/robot/land", and return whether it succeeded."""
        from std_srvs.srv import Trigger

        return self.call(Trigger, service).success

    def activate(self, name):
        """Activate a robot's node, as soon as it has perceived everybody."""
        self.wait(lambda: len(self.position) == len(self.names))
        while not self.change(name, "activate"):
            self.executor.spin_once(timeout_sec=0.2)

    def send(self, name, goal, frame="map"):
        """Send a robot a goal."""
        publisher = self.goals[name]
        self.wait(lambda: publisher.get_subscription_count() > 0)
        message = msgs().PoseStamped()
        message.header.frame_id = frame
        place = message.pose.position
        place.x, place.y, place.z = map(float, goal)
        publisher.publish(message)

    def wait(self, done):
        """Take messages until something is so."""
        ends = time.monotonic() + MOST
        while not done():
            for name, process in self.processes.items():
                if process.poll() is not None:
                    raise RuntimeError(f"the process of {name} ended with exit status {process.returncode}")
            if time.monotonic() > ends:
                raise TimeoutError(f"waited for {MOST} s; the last status was {self.status}")
            self.executor.spin_once(timeout_sec=0.05)

    def _start(self, name, module, parameters, words=(), stderr=None):
        given = [word for one, value in parameters.items() for word in ("-p", f"{one}:={json.dumps(value)}")]
        command = [sys.executable, "-m", module, "--ros-args", *words, *given]
        self.processes[name] = subprocess.Popen(command, stderr=stderr)


def swap(operator, policy, **parameters):
    """Let robots exchange their places two by two, and land. Return how far they ended from their goals (m)."""
    names = operator.names
    for name in names:
        operator.start_robot(name, policy=policy, **parameters)
    for name in names:
        assert operator.change(name, "configure"), name
    for name in names:
        operator.activate(name)
    places = {name: operator.position[name].copy() for name in names}
    goals = {name: places[names[k ^ 1]] for k, name in enumerate(names)}
    for name, goal in goals.items():
        operator.send(name, goal)

    def errors():
        return [float(np.linalg.norm(operator.position[name] - goal)) for name, goal in goals.items()]

    operator.wait(lambda: max(errors()) < 0.3)
    arrived = errors()
    for name in names:
        operator.change(name, "deactivate")
    operator.wait(lambda: all(operator.told(name, "mode") == "idle" for name in names))
    operator.wait(lambda: operator.told("world", "on the ground") == " ".join(names))
    return arrived


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n-robots", type=int, default=4, help="an even number")
    parser.add_argument("--policy", default="full", help="a rule, or the folder of an exported model")
    parser.add_argument("--quick", action="store_true", help="two robots only")
    args = parser.parse_args()
    names = [f"robot_{k}" for k in range(2 if args.quick else args.n_robots)]
    with Operator(names) as operator:
        operator.start_world(scenario="symmetric_swap")
        print("from their goals (m):", *(f"{one:.2f}" for one in swap(operator, args.policy)))
        for name in ["world", *names]:
            print(name, operator.status[name])


if __name__ == "__main__":
    main()
