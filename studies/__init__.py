"""Studies: code and data behind the claims about the packages."""

import os

# Before NumPy is imported: studies use one process per core
os.environ.setdefault("OMP_NUM_THREADS", "1")
