"""The report encoder of each uplink."""

from __future__ import annotations

from shared.wire import Uplink
from simulator.client.report_encoders import DeltaReports, FullReports


def encoder_of(uplink: Uplink) -> FullReports:
    """How reports are sent on that uplink."""
    match uplink:
        case "full":
            return FullReports()
        case "delta":
            return DeltaReports()
        case "pruned":
            # The features take a while to import, which the other uplinks need not wait for.
            from simulator.client.pruned_reports import PrunedReports

            return PrunedReports()
