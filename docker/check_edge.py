"""Check of an installed edge: the build of the edge's image and `make release` run it.

It starts the edge as the image does, asks for decisions in every mode with the LLM, the planner and a store, waits
until the edge has learned, and downloads the mission page.
"""

import importlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request

LLM_S, DECISIONS = 300, 3
MODES = ("policy", "value", "llm", "guided")


def main() -> None:
    """Raise an error if anything fails."""
    # The edge imports these only for some settings.
    for extra in ("psycopg", "opentelemetry.exporter.otlp.proto.http.trace_exporter"):
        importlib.import_module(extra)
    with tempfile.TemporaryDirectory() as folder:
        env = {**os.environ, "AICVDS_STORE": f"{folder}/missions.db"}
        command = ["aicvds", "serve", "--port", "0"]
        with subprocess.Popen(command, env=env, stderr=subprocess.PIPE, text=True) as edge:
            assert edge.stderr is not None
            url = re.search(r"http://[\d.:]+", edge.stderr.readline())
            assert url is not None
            try:
                decide(url[0])
                show(url[0])
            finally:
                edge.send_signal(signal.SIGTERM)
                sys.stderr.write(edge.communicate(timeout=30)[1])


def decide(url: str) -> None:
    """Fly a short mission in each mode."""
    begun = time.monotonic()
    while (llm := asked(f"{url}/readyz")["llm"]) != "ready":
        assert llm == "loading" and time.monotonic() < begun + LLM_S, f"the LLM is {llm}"
        time.sleep(0.2)
    body = asked(f"{url}/openapi.json")["paths"]["/decide"]["post"]["requestBody"]["content"]["application/json"]
    example = body["examples"]["paper"]["value"] | {"deadline_ms": 60_000}
    stored = False
    for mode in MODES:
        asked(f"{url}/missions/{mode}", {"mode": mode}, "PUT")
        outcome = None
        for step in range(DECISIONS):
            answer = asked(f"{url}/decide", {**example, "mission_id": mode, "step": step, "outcome": outcome})
            assert answer["source"] == mode, f"mode {mode} answered {answer}"
            outcome = {"decision_id": answer["decision_id"], "cost": 0.2}
            stored = stored or answer["stored"]
    assert stored, "nothing is stored"
    assert answer["guided"]["trust"].keys() >= {"llm", "planner", "value"}, answer["guided"]
    while not asked(f"{url}/missions/value")["learner_updates"]:
        assert time.monotonic() < begun + LLM_S, "nothing is learned"
        time.sleep(0.2)


def show(url: str) -> None:
    """Download the mission page and its files."""
    page = fetched(f"{url}/").decode()
    parts = re.findall(r'(?:src|href)="(static/[^"]+)"', page)
    assert parts, page
    for part in parts:
        assert fetched(f"{url}/{part}"), part


def asked(url: str, body: object = None, method: str | None = None) -> dict:
    """The edge's answer, from JSON."""
    content = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url, content, {"Content-Type": "application/json"}, method=method)
    return json.loads(fetched(request))


def fetched(request: str | urllib.request.Request) -> bytes:
    """The body of the answer; the request uses no proxy."""
    with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(request, timeout=90) as answer:
        return answer.read()


if __name__ == "__main__":
    main()
