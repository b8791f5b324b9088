"""The scripts in examples/ run."""

import importlib.util
import os
import re
import runpy
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch as th
from mpe2 import simple_spread_v3
from network import alone

from quad_swarm.world.presets import make_config
from reference import drawn
from sb3_maddpg import MADDPG

EXAMPLES = Path(__file__).parents[2] / "examples"


WORDS = {"rl_zoo3_train.py": ["--algo", "masac", "--env", "OwnBit-v0", "--conf-file", "r.yml", "--eval-freq", "100"]}
RECIPE = "OwnBit-v0: {n_timesteps: 300, policy: MlpPolicy, learning_starts: 50, batch_size: 16, buffer_size: 500}\n"


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.glob("*.py")))
def test_runs_in_its_short_form(name, tmp_path):
    (tmp_path / "r.yml").write_text(RECIPE)
    before = []
    if name == "ros2_nodes.py":
        pytest.importorskip("rclpy")
        before = alone()
    command = [*before, sys.executable, str(EXAMPLES / name), *WORDS.get(name, ["--quick"])]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout
    assert f"]({name})" in (EXAMPLES / "README.md").read_text()


@pytest.mark.slow
def test_a_robot_lands_at_ctrl_c(tmp_path):
    command = [sys.executable, str(EXAMPLES / "robot_loop.py"), "--duration", "400"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert all("holds its start" in process.stdout.readline() for _robot in range(2))
    os.killpg(process.pid, signal.SIGINT)
    said = process.communicate(timeout=500)[0]
    assert process.returncode == 0
    assert said.count("landed") == 2


def test_a_robot_says_what_it_senses_and_commands_nothing(tmp_path):
    states = np.hstack([[[-2.0, 0, 1.5], [2.0, 0.1, 1.5]], np.zeros((2, 6))])
    states.tofile(tmp_path / "states")
    words = ["--index", "1", "--rule", "none", "--shared", str(tmp_path / "states"), "--sense"]
    words += ["--addresses", "127.0.0.1:5", "127.0.0.1:6"]
    command = [sys.executable, str(EXAMPLES / "robot_loop.py"), *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    said = process.stdout.readline() + process.stdout.readline()
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=500)
    assert process.returncode == 0
    assert said.count("at [2.  0.1 1.5] m") == 2
    assert "others at [[-2.0, 0.0, 1.5]] m" in said


@pytest.mark.parametrize(
    ("goals", "message"),
    [
        ([[9.0, 9, 9], [-2, 0, 1.5]], "goals[0]=[9.0, 9.0, 9.0] is 8.88 m outside the workspace"),
        ([[2.0, 0, 1.5], [2, 0.1, 1.5]], "cannot be at both goals"),
        ([[2.0, 0, 1.5]], "2 STARTS and 1 GOALS for 2 robots; edit them in"),
    ],
)
def test_a_robot_refuses_goals_that_no_team_can_fly_to(goals, message):
    names = runpy.run_path(str(EXAMPLES / "robot_loop.py"))
    names["check_team"].__globals__["GOALS"] = np.array(goals)
    with pytest.raises(ValueError, match=re.escape(message)):
        names["check_team"]([("10.0.0.1", 1), ("10.0.0.2", 1)], make_config("flight-v2", n_robots=2))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--index", "0", "--shared=x", "--addresses", "127.0.0.1:5", "127.0.0.1:5"],
            "1 different ones for 2 robots",
        ),
        (
            ["--index", "0", "--shared=x", "--addresses", "203.0.113.9:5", "127.0.0.1:6"],
            "cannot receive at 203.0.113.9:5",
        ),
        (["--index", "0", "--addresses", "127.0.0.1:99999"], "with a port up to 65535"),
        (["--addresses", "127.0.0.1:5", "127.0.0.1:6"], "which robot is this one?"),
        (["--index", "0", "--addresses", "127.0.0.1:5", "127.0.0.1:7"], "--index needs --files"),
        (["--duration", "-5"], "--duration -5: it must be a number above 0"),
    ],
)
def test_a_robot_says_what_its_command_line_lacks(words, message):
    begins = str(time.time_ns() // 1000 + 500_000_000)
    words = [*words, "--rule", "none", *(["--begins", begins] if "--index" in words else [])]
    command = [sys.executable, str(EXAMPLES / "robot_loop.py"), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode != 0
    assert message in done.stderr.splitlines()[-1]


@pytest.mark.slow
@pytest.mark.parametrize("by", ["sb3_maddpg", "rl_zoo3"])
def test_both_zoos_show_and_plot_the_runs_of_each_other(by, tmp_path):
    """Folders, files and options are the same."""
    (tmp_path / "r.yml").write_text(RECIPE)
    zoo = [sys.executable, str(EXAMPLES / "rl_zoo3_train.py")]
    own = [sys.executable, "-m", "sb3_maddpg"]
    words = ["--algo", "maddpg", "--env", "OwnBit-v0", "--conf-file", "r.yml", "--eval-freq", "100", "--verbose", "0"]
    enjoy = ["--algo", "maddpg", "--env", "OwnBit-v0", "-f", "logs", "-n", "30", "--no-render"]
    hook = f"import runpy; runpy.run_path({str(EXAMPLES / 'rl_zoo3_train.py')!r}); "
    plot = [sys.executable, "-m", "rl_zoo3.plots.plot_train", "--algo", "maddpg", "--env", "OwnBit-v0", "-f", "logs"]
    for command in (
        [*([*own, "train"] if by == "sb3_maddpg" else zoo), *words],
        [*own, "enjoy", *enjoy],
        [sys.executable, "-c", f"{hook}from rl_zoo3.enjoy import enjoy; enjoy()", *enjoy],
        plot,
    ):
        env = {**os.environ, "MPLBACKEND": "Agg"}
        done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=500, check=False)
        assert done.returncode == 0, (command, done.stderr)
        assert command is plot or "train" in command or command[:2] == zoo or "3 Episodes" in done.stdout


def test_the_single_file_does_the_update_of_the_package():
    """Networks and batch are the package's; what they are after one update is compared."""
    spec = importlib.util.spec_from_file_location("single_file", EXAMPLES / "maddpg_single_file.py")
    single = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(single)
    env = simple_spread_v3.parallel_env(continuous_actions=True)
    model = MADDPG("MlpPolicy", env, gamma=single.GAMMA, tau=single.TAU, batch_size=64, learning_starts=100, seed=0)
    model.learn(300)
    policy = model.policy
    n, obs_dim, width = 3, policy.team.obs_dim, policy.actions.width
    agents = [single.Agent(obs_dim, width, n * obs_dim, n * width) for _ in range(n)]
    names = ("actor", "critic", "actor_target", "critic_target")
    for row, agent in enumerate(agents):
        for name in names:
            getattr(agent, name).load_state_dict(network_of(getattr(policy, name), row).state_dict())
        for name in ("actor", "critic"):
            state = getattr(policy, name).optimizer.state
            mine = getattr(agent, f"{name}_optimizer")
            layers = [*getattr(policy, name).net.layers()]
            for (weight, bias), linear in zip(
                layers, [one for one in getattr(agent, name) if hasattr(one, "bias")], strict=True
            ):
                for parameter, own in ((weight, linear.weight), (bias, linear.bias)):
                    mine.state[own] = {
                        key: one.clone() if one.dim() == 0 else one[row].reshape(own.shape).clone()
                        for key, one in state[parameter].items()
                    }
    data = drawn(model, 64)
    single.update(
        agents,
        *(
            [part[:, row] for row in range(n)]
            for part in (
                data.observations,
                policy.actions.encode(data.actions),
                data.rewards,
                data.next_observations,
                data.dones,
            )
        ),
    )
    before = [parameter.clone() for parameter in policy.parameters()]
    model.train(1, batch_size=64)
    assert any((old != new).any() for old, new in zip(before, policy.parameters(), strict=True))
    for row, agent in enumerate(agents):
        for name in names:
            for own, theirs in zip(
                getattr(agent, name).parameters(), network_of(getattr(policy, name), row).parameters(), strict=True
            ):
                assert th.allclose(own, theirs, atol=1e-6), name


def network_of(networks, row):
    return networks.net.single(row, networks.net.layers()[0][0].shape[2])
