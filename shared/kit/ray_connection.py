"""The connection of a command to Ray: to one started here for the command, or to a cluster."""

import logging
import os
import secrets
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# The value of `--ray` that starts Ray on this machine; any other is the address of a cluster.
LOCAL = "local"
# What passes through Ray is small, and Ray would reserve 30% of the memory for it.
_OBJECT_STORE_BYTES = 100_000_000


class RayUnusable(ValueError):
    """There is no Ray at that address, or its workers cannot run this program; the text says what to do."""


@contextmanager
def connected(address: str, cores: int) -> Iterator[None]:
    """Within the context, this process is connected to Ray, without usage statistics and dashboard.

    A Ray that is started here has its own token. Ray reads it when it is imported, so nothing may import Ray earlier,
    as ``torchrl.envs`` does.

    Args:
        address: ``local`` to start Ray on this machine, or the address of a cluster of which this machine is a part.
        cores: of a Ray that is started here, whatever the machine has.

    Raises:
        RayUnusable: Ray is not installed, or not at that address.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    # Otherwise each worker warns that a future release will leave CUDA_VISIBLE_DEVICES as it is.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    if address == LOCAL and "RAY_AUTH_MODE" not in os.environ:
        # Ray, which reads this when it is imported, would write a token into the user's home. That would change how the
        # user's own clusters start.
        os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    try:
        import ray
    except ModuleNotFoundError as missing:
        raise RayUnusable(
            f"--ray: {missing.name} is not installed. Install the extra: pip install 'aic-vds[ray]'"
        ) from None
    own: dict[str, Any] = {"num_cpus": cores, "object_store_memory": _OBJECT_STORE_BYTES, "include_dashboard": False}
    # Ray replaces the handler of SIGTERM.
    on_sigterm = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR, **(own if address == LOCAL else {}))
    except (ConnectionError, ValueError, RuntimeError) as error:
        why = f"{str(error).splitlines()[0]}; a cluster with tokens needs RAY_AUTH_MODE=token and RAY_AUTH_TOKEN"
        raise RayUnusable(f"--ray {address}: {why}") from None
    finally:
        signal.signal(signal.SIGTERM, on_sigterm)
    try:
        yield
    finally:
        ray.shutdown()
