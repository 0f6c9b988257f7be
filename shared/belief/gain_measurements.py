"""The measurements of one report's gains."""

from dataclasses import dataclass

import numpy as np

from shared.world.channel import FloatArray


@dataclass(frozen=True, eq=False)
class Measured:
    """The measurements of a report.

    Attributes:
        excess_db: shape ``(n,)``, excess losses of the sensors in radio range that were heard in this step, dB.
        radio_failed: whether the UAV's last transmission failed over a good link.
    """

    excess_db: FloatArray
    radio_failed: bool = False


NOTHING_MEASURED = Measured(np.zeros(0))
