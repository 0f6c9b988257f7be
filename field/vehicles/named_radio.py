"""The radio that the option ``--radio`` names."""

from __future__ import annotations

from collections.abc import Callable

from field.vehicles.radio import Radio
from field.vehicles.simulated_radio import SimulatedRadio
from shared.kit.own_code import imported
from simulator.errors import UsageError
from simulator.sites.site import Site

SIMULATED = "simulated"


def radio_named(name: str, site: Site, seed: int) -> Radio:
    """The radio of the option ``--radio``: ``simulated``, or ``MODULE:NAME``, a callable that takes the site.

    Raises:
        UsageError: there is no such module or callable.
    """
    if name == SIMULATED:
        return SimulatedRadio(site, seed)
    if ":" not in name:
        raise UsageError(f"--radio {name}: write simulated, or MODULE:NAME of your own, such as my_radio:Radio")
    try:
        make: Callable[[Site], Radio] = imported(name)
    except ValueError as error:
        raise UsageError(f"--radio {name}: {error}") from None
    return make(site)
