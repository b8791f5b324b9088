"""A network that contains nothing but this machine."""

import shutil
import subprocess

import pytest


def alone() -> list[str]:
    """Return what comes before a command that runs in a network namespace of its own: nothing can leave the machine,
    and tests beside each other do not meet. Skip the test if there are none."""
    words = ["unshare", "--net", "--map-root-user", "sh", "-c", 'ip link set lo up && exec "$@"', "sh"]
    if shutil.which("ip") is None or subprocess.run([*words, "true"], capture_output=True, check=False).returncode:
        pytest.skip("no network namespaces here")
    return words
