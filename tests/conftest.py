"""One thread per process: the networks are small and the tests run in parallel."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
