"""The base of every record that a run leaves on disk."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Record(BaseModel):
    """Files written by an older version may lack a field and those by a newer one have more."""

    model_config = ConfigDict(frozen=True, extra="ignore")
