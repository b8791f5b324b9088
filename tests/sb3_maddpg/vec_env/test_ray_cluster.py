"""Connections to Ray."""

import sys

import pytest

from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.vec_env.ray import RayVecEnv
from sb3_maddpg.vec_env.ray_cluster import connect


def test_without_ray_the_message_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r'Ray is not installed .*pip install -e "\.\[ray\]"'):
        RayVecEnv([OwnBit])


def test_an_address_where_nobody_answers(monkeypatch):
    pytest.importorskip("ray")
    # "auto" must not find the clusters of tests that run at the same time
    monkeypatch.setattr("ray._private.services._find_address_from_flag", lambda flag: set())
    for address in ("auto", "127.0.0.1:1", "127.0.0.1:99999"):
        with pytest.raises(ValueError, match=f"address='{address}': no Ray cluster responds there"):
            connect(address, 1)


@pytest.mark.slow
def test_only_the_first_call_connects(monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")  # of another cluster, as in any job of Ray
    ray, connected = connect(None, 1)
    try:
        assert connected
        assert ray.cluster_resources()["CPU"] == 1
        assert connect(None, 2) == (ray, False)
    finally:
        ray.shutdown()
