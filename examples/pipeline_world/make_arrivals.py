"""Make arrivals.csv beside this file:  python examples/pipeline_world/make_arrivals.py

Ten minutes of traffic in steps of ten seconds. Every sensor reports at a rate of its own, which rises by half and
falls again with the line's pressure. A cleaning pig passes from kilometre 1.5 to 4.5 at 5 m/s, and the sensors within
400 m of its noise report six times as much. The counts are Poisson draws of these rates.
"""

import csv
import json
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parent
STEPS, STEP_S, SEED = 60, 10.0, 20_260_401
PIG_FROM_M, PIG_SPEED, PIG_HEARD_M, PIG_FACTOR = 1500.0, 5.0, 400.0, 6.0


def main() -> None:
    """Write the file."""
    features = json.loads((FOLDER / "world.geojson").read_text(encoding="utf-8"))["features"]
    sensors = [f["properties"]["id"] for f in features if f["properties"]["role"] == "sensor"]
    # kp-2.57 is at kilometre 2.57 of the pipeline.
    along_m = np.array([1000.0 * float(name.removeprefix("kp-")) for name in sensors])
    rng = np.random.default_rng(SEED)
    usual = rng.uniform(1.0, 3.0, len(sensors))
    step = np.arange(STEPS)[:, None]
    swell = 1.0 + 0.5 * np.sin(np.pi * step / STEPS)
    pig_m = PIG_FROM_M + PIG_SPEED * STEP_S * step
    noisy = np.where(np.abs(along_m - pig_m) < PIG_HEARD_M, PIG_FACTOR, 1.0)
    packets = rng.poisson(usual * swell * noisy)
    with (FOLDER / "arrivals.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["step", *sensors])
        rows.writerows([t, *counts] for t, counts in enumerate(packets.tolist()))


if __name__ == "__main__":
    main()
