import subprocess
import sys

import pytest

SCRIPT = """
import asyncio
from contextlib import suppress
import psutil
from service import allocator

allocator.hand_back_memory()
allocator._TRIM_EVERY_S = 0.01
pieces = [bytearray(b"x" * 60_000) for _ in range(2000)]
del pieces[::2]
before = psutil.Process().memory_info().rss


async def main():
    with suppress(TimeoutError):
        await asyncio.wait_for(allocator.trim_now_and_then(), 1)


asyncio.run(main())
print((before - psutil.Process().memory_info().rss) / 1e6)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc's malloc")
def test_what_lies_free_between_pieces_in_use_goes_back_to_the_system() -> None:
    told = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    assert float(told.stdout) > 30
