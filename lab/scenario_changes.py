"""The options that change a scenario, for every command of the laboratory that flies one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from tyro.conf import UseAppendAction, arg

from simulator.commands.options import changes_of


@dataclass(frozen=True, kw_only=True)
class ScenarioChanges:
    """Other numbers for the fields of ``--scenario``."""

    sensors: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Sensors in the scenario, 1 to 2000. Default: the scenario's."""
    uavs: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """UAVs in the scenario, 1 to 100. Default: the scenario's."""
    set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="FIELD=VALUE")] = ()
    """Another value for a field of the scenario, such as wind_mps=4; repeatable, as for `aicvds simulate`."""

    @property
    def changes(self) -> dict[str, Any]:
        """The new values by field; raises ``UsageError``."""
        return changes_of(self.set, self.sensors, self.uavs)
