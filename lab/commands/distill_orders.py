"""``python -m lab distill-orders``: the embedded LLM's adapter for operators' notes."""

from __future__ import annotations

from lab.commands.distill import trained
from lab.distilling.options import DistillOrders


def main(argv: list[str]) -> int:
    """Train and write; returns the exit code."""
    return trained(DistillOrders, "distill-orders", argv)
