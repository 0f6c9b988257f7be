"""The smoothness of the mission page: the time between frames in headless Chromium, with 100 sensors and 10 UAVs.

    python -m benchmarks.page --seconds 20

It starts an edge, opens its page, and asks for ten UAVs' decisions ten times a second. The browser reports the times
between its frames, and between its updates of the page. It measures the same page before, without updates, and prints
both. Without Chromium it measures nothing and exits with 1.
"""

from __future__ import annotations

import shutil
import threading
import time
from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np
from playwright.sync_api import CDPSession, Page, sync_playwright

from benchmarks.harness import Options, Report, edge, run

FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
UPDATES_A_SECOND = 10
FRAMES = """seconds => new Promise(done => {
    const frames = [], drawn = [];
    const observer = new MutationObserver(() => drawn.push(performance.now()));
    observer.observe(document.getElementById("mission"), {attributes: true, attributeFilter: ["data-made"]});
    const ends = performance.now() + 1000 * seconds;
    const next = now => {
        frames.push(now);
        if (performance.now() < ends) requestAnimationFrame(next);
        else { observer.disconnect(); done({frames, drawn}); }
    };
    requestAnimationFrame(next);
})"""


@dataclass(frozen=True)
class Smoothness(Options):
    """Measure the page's frames."""

    seconds: float = 20.0
    """Seconds of each measurement, with updates and without."""
    sensors: int = 100
    """Sensors on the map."""
    uavs: int = 10
    """UAVs that get a decision at every update."""


def batch_body(step: int, sensors: int, uavs: int) -> dict[str, Any]:
    """The body of a batch: UAVs that fly east over a grid of sensors."""
    side = int(np.ceil(np.sqrt(sensors)))
    columns = {
        "id": list(range(sensors)),
        "x": [1000.0 * (i % side + 0.5) / side for i in range(sensors)],
        "y": [1000.0 * (i // side + 0.5) / side for i in range(sensors)],
        "queue": [float((7 * i + 3 * step) % 60) for i in range(sensors)],
        "battery": [50.0] * sensors,
        "channel_gain": [-90.0] * sensors,
        "last_seen": [step] * sensors,
    }
    places = [[(10.0 + 15 * step) % 1000, 1000.0 * (u + 0.5) / uavs] for u in range(uavs)]
    states = [{"uav_id": u, "position": place, "sensors": columns} for u, place in enumerate(places)]
    return {"mission_id": "many", "step": step, "uavs": states}


def fly(url: str, options: Smoothness, stop: threading.Event) -> None:
    """Request the fleet's decisions, at most ten times a second."""
    with httpx.Client(base_url=url, timeout=60) as client:
        began, step = time.monotonic(), 1
        while not stop.is_set():
            client.post("/decide/batch", json=batch_body(step, options.sensors, options.uavs)).raise_for_status()
            time.sleep(max(0.0, began + step / UPDATES_A_SECOND - time.monotonic()))
            step += 1


def main_thread_s(session: CDPSession) -> float:
    """Processor seconds of the page's main thread, painting in software included."""
    metrics = {m["name"]: float(m["value"]) for m in session.send("Performance.getMetrics")["metrics"]}
    return metrics["TaskDuration"]


def watched(page: Page, seconds: float) -> dict[str, float]:
    """Frames and updates a second, milliseconds from frame to frame, and the share that the page's thread computes."""
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable", {"timeDomain": "threadTicks"})
    before = main_thread_s(session)
    measured = page.evaluate(FRAMES, seconds)
    busy = (main_thread_s(session) - before) / seconds
    session.detach()
    gaps = np.diff(measured["frames"])
    p50, p95, p99 = np.percentile(gaps, (50, 95, 99)).tolist()
    rates = {"frames a second": len(gaps) / seconds, "updates a second": len(measured["drawn"]) / seconds}
    return {**rates, "p50 ms": p50, "p95 ms": p95, "p99 ms": p99, "most ms": float(gaps.max()), "busy": busy}


def measure(options: Smoothness) -> Report:
    """Watch the page without updates and with them."""
    chromium = shutil.which("chromium")
    if chromium is None:
        raise SystemExit("this needs a browser: apt-get install --no-install-recommends chromium")
    stop, found = threading.Event(), dict[str, dict[str, float]]()
    with edge({"MODE": "value", "STORE": "none"}) as server:
        flying = threading.Thread(target=fly, args=(server.url, options, stop))
        spec = {"scenario": {"name": "many", "sensors": options.sensors, "uavs": options.uavs}}
        with httpx.Client(base_url=server.url, timeout=60) as client:
            client.put("/missions/many", json=spec).raise_for_status()
            client.post("/decide/batch", json=batch_body(0, options.sensors, options.uavs)).raise_for_status()
        try:
            with sync_playwright() as playwright:
                browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
                page = browser.new_page(viewport={"width": 1280, "height": 900})
                page.goto(f"{server.url}/?mission=many")
                page.wait_for_selector("#mission:not([hidden])")
                found["nothing happens"] = watched(page, options.seconds)
                flying.start()
                found[f"{options.sensors} sensors, {options.uavs} UAVs"] = watched(page, options.seconds)
                browser.close()
        finally:
            stop.set()
            if flying.ident is not None:
                flying.join()
    return Report({"frames": found}, {"The mission page": found})


if __name__ == "__main__":
    run(Smoothness, measure)
