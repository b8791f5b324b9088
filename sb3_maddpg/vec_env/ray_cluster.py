"""Connection to a Ray cluster (https://docs.ray.io), an optional dependency."""

import os
import re
import socket
from contextlib import suppress
from logging import WARNING
from typing import Any

from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.utils import shown


def connect(address: str | None, cpus: int) -> tuple[Any, bool]:
    """
    Connect this process to a Ray cluster, unless it is connected already.

    :param address: address of a running cluster, ``auto`` or ``HOST:PORT``; None starts a cluster on this machine
    :param cpus: number of processes of a cluster that is started here
    :return: the module ``ray``, and whether this call has connected; the caller then calls ``ray.shutdown`` at the end
    :raises ValueError: if Ray is not installed, or there is no such cluster
    """
    try:
        import ray
    except ImportError as error:
        raise InvalidArgumentError(f'Ray is not installed ({error}): in the clone, pip install -e ".[ray]".') from error
    if ray.is_initialized():
        return ray, False
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # do not report usage unasked
    try:
        if address is not None and (found := re.fullmatch(r"([^/]+):(\d+)", address)):
            socket.create_connection((found[1], int(found[2])), timeout=5.0).close()  # Ray would wait for minutes
            _use_token()
        ray.init(
            address=address or "local",  # None would follow RAY_ADDRESS or a cluster found here
            num_cpus=None if address else cpus,
            include_dashboard=None if address else False,
            log_to_driver=False,
            logging_level=WARNING,
        )
    except (OSError, OverflowError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
        raise InvalidArgumentError(
            f"address={shown(address)}: no Ray cluster responds there ({shown(str(error))[1:-1]}). If it asks for a "
            "token, put the cluster's token into ~/.ray/auth_token and set RAY_AUTH_MODE=token."
        ) from error
    return ray, True


def _use_token() -> None:
    """Use the user's token if there is one, as Ray does only for clusters that it finds on this machine."""
    with suppress(ImportError):  # Ray before 2.56 uses none unless RAY_AUTH_MODE says so
        from ray._private.authentication import authentication_token_setup

        authentication_token_setup.maybe_enable_token_auth_if_token_available(warn_if_disabled=False)
