"""``aicvds distill-orders``: the embedded LLM's adapter for operators' notes."""

from __future__ import annotations

from service.commands.distill import trained
from service.distilling.options import DistillOrders


def main(argv: list[str]) -> int:
    """Train and write; returns the exit code."""
    return trained(DistillOrders, "distill-orders", argv)
