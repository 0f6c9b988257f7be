"""``aicvds serve --ray``: the replicas that own missions, and the ingress in this process."""

import socket

from starlette.applications import Starlette

from service.cluster.ingress import ingress_application
from service.config.settings import Settings
from service.server.server import Server
from shared.kit.ray_connection import LOCAL, RayUnusable, connected

_LOOPBACK = "127.0.0.1"


def serve_cluster(listener: socket.socket, settings: Settings, ray: str, least: int, most: int) -> Server:
    """Serve until SIGTERM or Ctrl-C; returns the server, whose ``error`` is the reason of a failure.

    There are ``least`` to ``most`` replicas, by load. Replicas on a Ray that was started here end with it; those on a
    cluster continue, because other ingresses may use them. If they cannot start, ``error`` is a :class:`RayUnusable`.

    Raises:
        RayUnusable: Ray is not installed, or not at that address.
    """

    def load() -> Starlette:
        # Ray reads its settings when it is imported, so this comes after the connection.
        try:
            from service.cluster.replicas import deployed, ended
        except ModuleNotFoundError as missing:
            raise RayUnusable(
                f"--ray: {missing.name} is not installed. Install the extra: pip install 'aic-vds[ray]'"
            ) from None

        owners = deployed(settings, _LOOPBACK if ray == LOCAL else None, least, most)
        return ingress_application(settings, owners, ended if ray == LOCAL else lambda: None)

    with connected(ray, most):
        server = Server(load, settings.log_level)
        # At a signal, uvicorn ends the process after the application.
        server.run(sockets=[listener])
    return server
