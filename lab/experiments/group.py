"""The flights of one scheme on one site."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from lab.experiments.flight import FlightRecord
from lab.experiments.plan import ExperimentPlan
from lab.experiments.schemes import Scheme


@dataclass(frozen=True)
class Group:
    """The flights of one scheme on one site in order of their seeds; ``suffix`` marks the site in names."""

    scheme: Scheme
    site: str
    suffix: str
    flights: list[FlightRecord]

    @property
    def seeds(self) -> list[int]:
        """The seeds flown."""
        return [flight.seed for flight in self.flights]


def groups_of(plan: ExperimentPlan, load: Callable[[str], FlightRecord | None]) -> list[Group]:
    """The plan's groups; those with a flight that has no record are left out."""
    sites = list(dict.fromkeys(planned.site_name for planned in plan.flights))
    flights: dict[tuple[str, str], list[FlightRecord]] = {}
    schemes = {planned.scheme.name: planned.scheme for planned in plan.flights}
    broken = set()
    for planned in plan.flights:
        at = (planned.scheme.name, planned.site_name)
        flight = load(planned.key)
        if flight is None:
            broken.add(at)
        else:
            flights.setdefault(at, []).append(flight)
    return [
        Group(schemes[name], site, f"@{site}" if len(sites) > 1 else "", found)
        for (name, site), found in flights.items()
        if (name, site) not in broken
    ]
