"""The report encoder of each uplink."""

from __future__ import annotations

from shared.client.report_encoders import DeltaReports, FullReports
from shared.wire.schemas import Uplink


def encoder_of(uplink: Uplink) -> FullReports:
    """The encoder of reports for that uplink."""
    match uplink:
        case "full":
            return FullReports()
        case "delta":
            return DeltaReports()
        case "pruned":
            # The features take a while to import, and only this uplink needs them.
            from shared.client.pruned_reports import PrunedReports

            return PrunedReports()
