"""The base of every record that a run leaves on disk."""

from pydantic import BaseModel, ConfigDict


class Record(BaseModel):
    """A record in a file; files of older versions may lack fields, and those of newer versions may have more."""

    model_config = ConfigDict(frozen=True, extra="ignore")
