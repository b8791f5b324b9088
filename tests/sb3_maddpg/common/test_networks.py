"""Stacked networks against separate ones."""

import pytest
import torch as th
from stable_baselines3.common.utils import polyak_update as sb3_polyak_update
from torch import nn

from sb3_maddpg.common.networks import FEW, StackedMLP, polyak_update

N, D, B = 4, 5, 6
GROUPS = {"separate": [0, 1, 2, 3], "shared": [0, 0, 0, 0], "grouped": [0, 1, 1, 0]}
each_sharing = pytest.mark.parametrize("groups", GROUPS.values(), ids=GROUPS)


@pytest.mark.parametrize("net_arch", [[], [8], [16, 8]])
@each_sharing
@pytest.mark.parametrize("batch", [1, FEW - 1, FEW])
def test_stacked_networks_equal_a_loop_of_separate_ones(net_arch, groups, batch):
    stacked = StackedMLP(groups, D, 2, net_arch, nn.Tanh)
    x = th.randn(batch, N, D).permute(1, 2, 0)  # as actors pass them
    for agent, group in enumerate(groups):
        y = x[agent].T
        for index, (weight, bias) in enumerate(zip(stacked.weights, stacked.biases, strict=True)):
            y = nn.functional.linear(y if index == 0 else y.tanh(), weight[group], bias[group, :, 0])
        assert th.allclose(stacked(x)[agent], y.T, atol=1e-6)
        assert th.allclose(stacked.single(agent, D)(x[agent].T), y, atol=1e-6)
        # Without the last two inputs, as if they were zero
        short = x[agent].T * th.tensor([1.0, 1.0, 1.0, 0.0, 0.0])
        whole = stacked.single(agent, D)(short)
        assert th.allclose(stacked.single(agent, D - 2)(short[:, : D - 2]), whole, atol=1e-6)


def test_a_single_network_has_its_own_parameters():
    stacked = StackedMLP(GROUPS["separate"], D, 2, [8])
    single, x = stacked.single(1, D), th.randn(B, D)
    before = single(x)
    with th.no_grad():
        stacked.weights[0].zero_()
    assert th.equal(single(x), before)


def test_stacked_networks_start_like_separate_ones():
    th.manual_seed(0)
    stacked, single = StackedMLP(range(200), 25, 40, []), nn.Linear(25, 200 * 40)
    for mine, theirs in ((stacked.weights[0], single.weight), (stacked.biases[0], single.bias)):
        assert mine.abs().max().item() == pytest.approx(theirs.abs().max().item(), rel=0.01)
        assert mine.std().item() == pytest.approx(theirs.std().item(), rel=0.03)
    assert not th.equal(stacked.weights[0][0], stacked.weights[0][1])


@each_sharing
def test_gradients_are_clipped_by_each_networks_own_norm(groups):
    net = StackedMLP(groups, D, 2, [8])
    scale = th.tensor([100.0, 1.0, 1e-4, 0.0]).view(N, 1, 1)
    (net(th.randn(N, D, B)) * scale).sum().backward()
    before = [[parameter.grad[group].clone() for parameter in net.parameters()] for group in range(max(groups) + 1)]
    net.clip_grad_norm_(0.5)
    for group, gradients in enumerate(before):
        norm = th.cat([gradient.flatten() for gradient in gradients]).norm().item()
        factor = min(1.0, 0.5 / (norm + 1e-6))
        for parameter, gradient in zip(net.parameters(), gradients, strict=True):
            assert th.allclose(parameter.grad[group], factor * gradient, atol=1e-7)


def test_targets_move_as_in_sb3():
    net, mine, other = (StackedMLP(GROUPS["grouped"], D, 2, [8]) for _ in range(3))
    other.load_state_dict(mine.state_dict())
    polyak_update(net.parameters(), mine.parameters(), 0.3)
    sb3_polyak_update(net.parameters(), other.parameters(), 0.3)
    assert all(th.allclose(a, b, atol=1e-7) for a, b in zip(mine.parameters(), other.parameters(), strict=True))


def test_what_is_put_in_the_place_of_parameters_is_used():
    net, x = StackedMLP(GROUPS["grouped"], D, 2, [8]), th.randn(N, D, B)
    zeros = {name: th.zeros_like(parameter) for name, parameter in net.named_parameters()}
    assert net(x).any()
    assert not th.func.functional_call(net, zeros, x).any()
    assert net(x).any()
    net.load_state_dict(zeros, assign=True)
    assert not net(x).any()
    assert not net.single(0, D)(x[0].T).any()
