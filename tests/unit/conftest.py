"""A unit test opens no socket and starts no process."""

from __future__ import annotations

import os
import socket
import subprocess
from collections.abc import Iterator
from typing import Any, NoReturn

import pytest


@pytest.fixture(autouse=True, scope="module")
def without_sockets_and_processes() -> Iterator[None]:
    """A connection, a listener or a child process is an error that says where such a test belongs."""

    def refused(*args: Any, **options: Any) -> NoReturn:
        raise AssertionError("a unit test opens no socket and starts no process: move it to tests/integration")

    with pytest.MonkeyPatch.context() as patch:
        for name in ("bind", "connect", "connect_ex"):
            patch.setattr(socket.socket, name, refused)
        patch.setattr(subprocess.Popen, "__init__", refused)
        patch.setattr(os, "fork", refused)
        yield
