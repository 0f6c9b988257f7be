"""Run while the edge's image is built, in it, and by `make release`: nothing that an edge needs may be missed.

Starts the edge as the image does, has every mode decide with its LLM, its planner and a store, lets it learn, and
fetches the mission page.
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
MODES = ("policy", "value", "guided")


def main() -> None:
    """Raise where anything fails."""
    # Imported where a setting asks for them.
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
    """A short mission in each mode."""
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
    """The mission page, with all that it names."""
    page = fetched(f"{url}/").decode()
    parts = re.findall(r'(?:src|href)="(static/[^"]+)"', page)
    assert parts, page
    for part in parts:
        assert fetched(f"{url}/{part}"), part


def asked(url: str, body: object = None, method: str | None = None) -> dict:
    """The answer, as JSON."""
    content = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url, content, {"Content-Type": "application/json"}, method=method)
    return json.loads(fetched(request))


def fetched(request: str | urllib.request.Request) -> bytes:
    """What comes back, by no proxy."""
    with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(request, timeout=90) as answer:
        return answer.read()


if __name__ == "__main__":
    main()
