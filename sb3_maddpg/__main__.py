"""``python -m sb3_maddpg``, the same as ``sb3-maddpg``."""

import sys

from sb3_maddpg.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
