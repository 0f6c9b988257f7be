"""A library's memory in a forked process: what the parent wrote to it, as the loader does, is the child's too."""

from __future__ import annotations

import subprocess
import sys

FORKED = """
import os
import llvmlite.binding as llvm
from shared.kit.memory import release_library
assert llvm.get_process_triple()
child = os.fork()
if child == 0:
    release_library("libllvmlite")
    llvm.parse_assembly("define i32 @one() { ret i32 1 }").verify()
    os._exit(0)
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def test_a_forked_process_may_give_a_library_back_that_its_parent_loaded() -> None:
    ended = subprocess.run([sys.executable, "-c", FORKED], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
