"""The errors of a call to a vehicle."""

from simulator.errors import RunFailed


class VehicleError(RunFailed):
    """A vehicle cannot be reached or did not carry out a command; the text says which, and what to do."""


class Unanswered(VehicleError):
    """A vehicle has not answered a command, which it may have carried out."""
