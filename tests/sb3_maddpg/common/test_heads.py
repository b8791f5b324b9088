"""Who earns which reward, with numbers that can be checked by hand."""

import pytest
import torch as th

from sb3_maddpg.common.buffers import TeamReplayBufferSamples
from sb3_maddpg.common.heads import PairHeads, TeamHead, ValueHeads

REWARDS = th.tensor([[1.0, 2.0, 6.0]])
OF_PAIRS = th.tensor([[[1.0, 0.0], [0.5, 1.5], [2.0, 4.0]]])
DONES = th.tensor([[0.0, 1.0, 0.0]])


def batch(**kwargs) -> TeamReplayBufferSamples:
    nothing = th.zeros(1, 3, 2)
    return TeamReplayBufferSamples(
        **{
            "observations": nothing,
            "actions": nothing,
            "next_observations": nothing,
            "dones": DONES,
            "rewards": REWARDS,
            "discounts": 0.5,
            "pair_rewards": OF_PAIRS,
            **kwargs,
        }
    )


def test_an_agents_head_earns_its_rewards_and_ends_with_it():
    heads = ValueHeads(3)
    assert len(heads) == 3
    assert heads.rewards(batch()).tolist() == [[1.0, 2.0, 6.0]]
    assert heads.discounts(batch()).tolist() == [[0.5, 0.0, 0.5]]
    assert heads.of_factors(th.tensor([[1.0, 2.0, 3.0]])).tolist() == [[1.0, 2.0, 3.0]]
    # Of agents whose actions have two factors each
    assert heads.of_factors(th.tensor([[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]])).tolist() == [[3.0, 7.0, 11.0]]
    assert (heads.owners(th.tensor([2])).tolist(), heads.of_agent(1).tolist()) == ([2], [1])


@pytest.mark.parametrize("n_neighbours", [1, 2])
def test_a_pairs_head_earns_the_pairs_rewards_and_ends_with_agent_or_pair(n_neighbours):
    heads = PairHeads(3, n_neighbours)
    of_pairs = OF_PAIRS[:, :, :n_neighbours]
    goes_on = th.tensor([[[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]])[:, :, :n_neighbours]
    data = batch(pair_rewards=of_pairs, pair_goes_on=goes_on)
    assert heads.rewards(data).tolist() == of_pairs.flatten(1).tolist()
    expected = 0.5 * th.tensor([[[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]])[:, :, :n_neighbours]
    assert heads.discounts(data).tolist() == expected.flatten(1).tolist()
    assert heads.discounts(batch()).tolist() == (0.5 * (1 - DONES)).repeat_interleave(n_neighbours, dim=1).tolist()
    # What an agent pays is shared by its pairs
    assert heads.of_factors(th.tensor([[2.0, 4.0, 6.0]])).sum().item() == pytest.approx(12.0)
    assert heads.sum_by_agent(heads.rewards(data)).tolist() == of_pairs.sum(dim=2).tolist()
    assert heads.owners(th.tensor([2 * n_neighbours])).tolist() == [2]
    assert len(heads.of_agent(1)) == n_neighbours


def test_the_teams_head_earns_the_mean_and_ends_with_the_last_agent():
    heads = TeamHead(3)
    assert heads.rewards(batch()).tolist() == [[3.0]]
    assert heads.discounts(batch()).tolist() == [[0.5]]
    assert heads.discounts(batch(dones=th.ones(1, 3))).tolist() == [[0.0]]
    assert heads.of_factors(th.tensor([[1.0, 2.0, 3.0]])).tolist() == [[2.0]]
    assert heads.in_units_of_value(th.tensor(3.0)).item() == 1.0
    assert heads.sum_by_agent(th.tensor([[4.0]])).tolist() == [[4.0, 4.0, 4.0]]
    assert (heads.owners(th.tensor([0])).tolist(), heads.of_agent(0).tolist()) == ([0, 1, 2], [])
