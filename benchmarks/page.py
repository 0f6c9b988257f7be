"""The smoothness of the mission page: the time between frames in headless Chromium, with 100 sensors and 10 UAVs.

    python benchmarks/page.py --seconds 20

It starts an edge, opens its page, and asks for ten UAVs' decisions ten times a second. The browser reports the times
between its frames, and between its updates of the page. It measures the same page before, without updates, and prints
both.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np
import tyro
from playwright.sync_api import CDPSession, Page, sync_playwright
from rich.console import Console

from simulator.flying.local_edge import HOST, usable_port

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
class Smoothness:
    """Measure the page's frames."""

    seconds: float = 20.0
    """Seconds of each measurement, with updates and without."""
    sensors: int = 100
    """Sensors on the map."""
    uavs: int = 10
    """UAVs that get a decision at every update."""


def report(step: int, sensors: int, uavs: int) -> dict[str, Any]:
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


def until_up(client: httpx.Client) -> None:
    """Wait for the edge, at most a minute."""
    for _ in range(600):
        try:
            client.get("/healthz")
            return
        except httpx.ConnectError:
            time.sleep(0.1)
    raise TimeoutError("the edge does not start")


def fly(url: str, options: Smoothness, stop: threading.Event) -> None:
    """Ask for the fleet's decisions, at most ten times a second."""
    with httpx.Client(base_url=url, timeout=60) as client:
        began, step = time.monotonic(), 1
        while not stop.is_set():
            client.post("/decide/batch", json=report(step, options.sensors, options.uavs)).raise_for_status()
            time.sleep(max(0.0, began + step / UPDATES_A_SECOND - time.monotonic()))
            step += 1


def main_thread_s(session: CDPSession) -> float:
    """Processor seconds of the page's main thread, painting in software included."""
    found = {one["name"]: float(one["value"]) for one in session.send("Performance.getMetrics")["metrics"]}
    return found["TaskDuration"]


def told(name: str, page: Page, seconds: float) -> str:
    """Measure; returns the result as a line."""
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable", {"timeDomain": "threadTicks"})
    before = main_thread_s(session)
    measured = page.evaluate(FRAMES, seconds)
    busy = (main_thread_s(session) - before) / seconds
    session.detach()
    gaps = np.diff(measured["frames"])
    drawn = len(measured["drawn"]) / seconds
    p50, p95, p99 = np.percentile(gaps, (50, 95, 99))
    return (
        f"{name}: {len(gaps) / seconds:.0f} frames and {drawn:.1f} updates a second; from frame to frame "
        f"{p50:.1f} ms (p50), {p95:.1f} (p95), {p99:.1f} (p99), {gaps.max():.0f} at most; "
        f"the page's thread computes {100 * busy:.0f}% of the time"
    )


def main() -> int:
    """Measure the page; returns the exit code."""
    options = tyro.cli(Smoothness, description=__doc__)
    console = Console()
    chromium = shutil.which("chromium")
    if chromium is None:
        console.print("this needs a browser: apt-get install --no-install-recommends chromium")
        return 2
    port = usable_port(0)
    url = f"http://{HOST}:{port}"
    environment = {**os.environ, "AICVDS_MODE": "value", "AICVDS_STORE": "none", "AICVDS_LOG_LEVEL": "warning"}
    edge = subprocess.Popen(
        [sys.executable, "-m", "shared.kit.command_line", "serve", "--host", HOST, "--port", str(port)], env=environment
    )
    stop = threading.Event()
    flying = threading.Thread(target=fly, args=(url, options, stop))
    try:
        spec = {"scenario": {"name": "many", "sensors": options.sensors, "uavs": options.uavs}}
        with httpx.Client(base_url=url, timeout=60) as client:
            until_up(client)
            client.put("/missions/many", json=spec).raise_for_status()
            client.post("/decide/batch", json=report(0, options.sensors, options.uavs)).raise_for_status()
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            page.goto(f"{url}/?mission=many")
            page.wait_for_selector("#mission:not([hidden])")
            console.print(told("nothing happens", page, options.seconds))
            flying.start()
            console.print(told(f"{options.sensors} sensors, {options.uavs} UAVs", page, options.seconds))
            browser.close()
    finally:
        stop.set()
        if flying.ident is not None:
            flying.join()
        edge.terminate()
        edge.wait(timeout=30)
    return 0


if __name__ == "__main__":
    sys.exit(main())
