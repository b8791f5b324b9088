"""Studies: what is claimed of the packages, with the code and the data behind it."""

import os

# Before numpy is imported: studies share out the cores by processes
os.environ.setdefault("OMP_NUM_THREADS", "1")
