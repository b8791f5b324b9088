"""
Train with rl_zoo3's own command instead of ``sb3-maddpg train``: needs ``pip install rl_zoo3 requests``.

``python examples/rl_zoo3_train.py --algo maddpg --env OwnBit-v0 --conf-file zoo_configs/maddpg.yml``
"""

import rl_zoo3
import rl_zoo3.train

import sb3_maddpg.team.toys  # noqa: F401  registers environments
from sb3_maddpg import IDDPG, MADDPG, MASAC, MATD3

rl_zoo3.ALGOS.update(maddpg=MADDPG, matd3=MATD3, masac=MASAC, iddpg=IDDPG)

if __name__ == "__main__":
    rl_zoo3.train.train()
