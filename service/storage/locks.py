"""The lock of a SQLite file, which belongs to one edge at a time; in PostgreSQL each mission has a lease."""

import fcntl
import os
import time
from typing import IO

# How long to retry a lock that another process has, and the interval.
_LAST_COMMIT_S, _RETRY_S = 1.0, 0.02


class StoreUnusable(Exception):
    """The store cannot be opened or written; the text gives the reason, without a password."""


class FileLock:
    """The lock of a SQLite file: it lasts as long as this process or the process that writes the file.

    Attributes:
        file: the real path; another edge may use a symbolic link to it.
        descriptors: of the lock file. A process that inherits it shares the lock.

    Raises:
        StoreUnusable: another edge has the lock, or may have it under another name of the file.
        OSError: the lock file cannot be made.
    """

    def __init__(self, file: str) -> None:
        self.file = os.path.realpath(file)
        self._lock: IO[str] = open(f"{self.file}.lock", "w")  # noqa: SIM115
        self.descriptors = (self._lock.fileno(),)
        # The writer of a killed edge may still be finishing its last commit.
        ends = time.monotonic() + _LAST_COMMIT_S
        while True:
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= ends:
                    self._lock.close()
                    raise StoreUnusable(f"another edge uses {self.file}") from None
            time.sleep(_RETRY_S)
        if os.path.exists(self.file) and os.stat(self.file).st_nlink > 1:
            self._lock.close()
            raise StoreUnusable(f"{self.file} has another name (a hard link), and SQLite a log for each: delete one")

    def close(self) -> None:
        """Release the lock."""
        self._lock.close()


def sqlite_file(store: str) -> str | None:
    """The file that a store setting names; None for PostgreSQL, `none` and malformed addresses."""
    if store == "none":
        return None
    if "://" not in store:
        return os.path.expanduser(store)
    # Importing it takes a fifth of a second, and a path needs none of it.
    from sqlalchemy import exc, make_url

    try:
        url = make_url(store)
    except (exc.ArgumentError, ValueError):
        return None
    return url.database if url.get_backend_name() == "sqlite" else None
