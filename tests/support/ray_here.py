"""A Ray of this machine for tests: it runs until standard input ends, and prints its address."""

from __future__ import annotations

import sys

import ray

if __name__ == "__main__":
    ray.init(
        "local",
        num_cpus=int(sys.argv[1]),
        include_dashboard=False,
        object_store_memory=100_000_000,
        log_to_driver=False,
    )
    print(ray.get_runtime_context().gcs_address, flush=True)
    sys.stdin.read()
