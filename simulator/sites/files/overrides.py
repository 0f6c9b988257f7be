"""``scenario.toml``: the fields of a world's scenario that differ from scenario ``paper``."""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from shared.kit.text_files import text_of
from shared.kit.validation_messages import problem_of
from shared.world.scenario import Scenario
from simulator.errors import UsageError
from simulator.sites.files.reading import quoted

MAX_BYTES = 1_000_000
# Fields that follow from the features, and fields that only circles and drawn layouts use.
FROM_FEATURES = frozenset({"sensors", "uavs", "layout", "sites", "routes", "area_m", "pipeline"})
UNUSED = frozenset({"lap_radius_m", "lap_offset_m", "pipeline_spread_m"})


@dataclass(frozen=True)
class Overrides:
    """Fields of a scenario, with the file and text that set them."""

    path: Path
    text: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)

    def scenario(self, derived: Mapping[str, Any]) -> Scenario:
        """The scenario ``paper`` with these fields and the derived ones.

        Raises:
            UsageError: a value is out of bounds or contradicts another; the text names the field and its line.
        """
        try:
            return Scenario.model_validate({**self.values, **derived})
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            key = str(first["loc"][0]) if first["loc"] else ""
            raise UsageError(f"{self.at(key)}: {key}{': ' if key else ''}{problem_of(first)}") from None

    def at(self, key: str) -> str:
        """The file and the line that sets a key, for messages."""
        sets = re.compile(rf"\s*[\"']?{re.escape(key)}\b")
        number = next((n for n, line in enumerate(self.text.splitlines(), 1) if key and sets.match(line)), None)
        return f"{self.path}, line {number}" if number else str(self.path)


def read_overrides(path: Path) -> Overrides:
    """The fields that a TOML file sets; none for a missing file.

    Raises:
        UsageError: the file cannot be read, is no TOML (the text names the line), or has a key that is no field or one
            that follows from the world's features.
    """
    if not path.exists():
        return Overrides(path)
    text = text_of(path, MAX_BYTES, UsageError)
    try:
        overrides = Overrides(path, text, tomllib.loads(text))
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path} is no TOML: {' '.join(str(error).split())}") from None
    for key in overrides.values:
        if key in FROM_FEATURES:
            raise UsageError(f"{overrides.at(key)}: {key} follows from world.geojson; take it out here")
        if key in UNUSED:
            raise UsageError(f"{overrides.at(key)}: a world with routes and sites does not use {key}; take it out")
        if key not in Scenario.model_fields:
            close = get_close_matches(key, set(Scenario.model_fields) - FROM_FEATURES - UNUSED, n=1)
            hint = f"did you mean {close[0]}?" if close else "its fields are those of shared/world/scenario.py"
            raise UsageError(f"{overrides.at(key)}: a scenario has no field {quoted(key)}; {hint}")
    return overrides
