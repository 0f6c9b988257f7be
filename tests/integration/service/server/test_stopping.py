"""The end of the server: every client that has connected is accepted before the listening sockets close."""

from __future__ import annotations

import socket

from service.server.server import waiting_clients


def test_every_client_that_waits_is_accepted() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.setblocking(False)
        clients = [socket.create_connection(listening.getsockname()) for _ in range(20)]
        accepted = list(waiting_clients(listening.fileno()))
        assert {one.getpeername() for one in accepted} == {client.getsockname() for client in clients}
        assert list(waiting_clients(listening.fileno())) == []
        # It listens on.
        socket.create_connection(listening.getsockname()).close()
    for one in (*accepted, *clients):
        one.close()
