"""The real embedded model: SmolLM2-135M out of the installed package, in this process, over its own HTTP server."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import httpx
import pytest
from fastapi import FastAPI

from service.api.app import create_app
from service.config.settings import Settings
from service.llm.embedded import EmbeddedServer
from tests.support.running import serving
from tests.support.stub_llm import wait_for
from tests.support.waiting import PATIENCE_S, Gate, until

Report = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def app() -> FastAPI:
    return create_app(Settings(mode="llm", llm_adapter="off", deadline_ms=60_000))


@contextmanager
def ready(app: FastAPI) -> Iterator[httpx.Client]:
    with ExitStack() as stack:
        patient = stack.enter_context(pytest.MonkeyPatch.context())
        for limit in ("connection.PROBE_TIMEOUT_S", "probing.TOGETHER_TIMEOUT_S", "calibration.TIMEOUT_S"):
            patient.setattr(f"service.llm.{limit}", PATIENCE_S)
        url = stack.enter_context(serving(app))
        client = stack.enter_context(httpx.Client(base_url=url, timeout=PATIENCE_S))
        readiness = wait_for(client, "ready")
        assert readiness["constraint"] == "grammar"
        assert "SmolLM2-135M" in readiness["model"]
        yield client


@pytest.fixture(scope="module")
def loaded(app: FastAPI) -> Iterator[httpx.Client]:
    with ready(app) as client:
        yield client


def measured(app: FastAPI) -> None:
    """Wait until the bias is measured, beside the decisions, which the first of a kind begins."""
    labels = app.state.engine.queries._labels
    until(lambda: labels._task is not None and labels._task.done())


def test_the_llm_decides_within_the_grammar(loaded: httpx.Client, report: Report) -> None:
    for step in range(4):
        answer = loaded.post("/decide", json=report(mission_id="grammar", step=step)).json()
        assert (answer["source"], answer["reason"]) == ("llm", None)
        assert answer["sensor_id"] in [c["sensor_id"] for c in answer["top_k"]]
        assert 0 <= answer["velocity"] <= 14


def test_the_static_block_is_read_once(loaded: httpx.Client, report: Report) -> None:
    """From the second decision on, the server has the static block and the earlier experiences in its cache."""
    first = loaded.post("/decide", json=report(mission_id="cache")).json()
    outcome = {"decision_id": first["decision_id"], "cost": 0.0}
    second = loaded.post("/decide", json=report(mission_id="cache", step=1, outcome=outcome)).json()
    third = loaded.post("/decide", json=report(mission_id="cache", step=1, uav_id=1)).json()
    for answer in (second, third):
        assert answer["tokens"]["cached"] >= answer["tokens"]["static"]
    assert third["tokens"]["cached"] > second["tokens"]["cached"]


@pytest.mark.long
def test_guided_asks_for_one_token_and_reads_little_anew(loaded: httpx.Client, app: FastAPI, report: Report) -> None:
    """At k = 5, once the bias is measured: the last experience, five rows, and the chat template's end."""
    loaded.put("/missions/guided", json={"mode": "guided"})
    outcome = None
    fresh = []
    for step in range(4):
        body = report(mission_id="guided", step=step, outcome=outcome)
        heard = {"queue": [52, 17, 33, 28, 60], "battery": [50.0] * 5, "channel_gain": [-90.0] * 5}
        body["sensors"] |= {**heard, "last_seen": [step] * 5, "x": [420.0, 650.0, 300.0, 520.0, 610.0]}
        answer = loaded.post("/decide", json=body).json()
        assert (answer["source"], answer["reason"]) == ("guided", None)
        assert len(answer["top_k"]) == 5
        tokens = answer["tokens"]
        assert tokens["completion"] == 1
        fresh.append(tokens["server_prompt"] - tokens["cached"])
        outcome = {"decision_id": answer["decision_id"], "cost": 0.2}
        # The server has one slot.
        measured(app)
    assert max(fresh[2:]) <= 70, fresh
    assert answer["guided"]["calibrated"]


@pytest.mark.long
def test_a_fleets_step_takes_one_call(loaded: httpx.Client, app: FastAPI, report: Report) -> None:
    """One letter a UAV and a line's end between them, each with the LLM's probabilities."""
    loaded.put("/missions/fleet", json={"mode": "guided"})
    for step in range(30):
        uavs = [{k: report(step=step, uav_id=i)[k] for k in ("uav_id", "position", "sensors")} for i in range(3)]
        body = {"mission_id": "fleet", "step": step, "uavs": uavs}
        before = calls(loaded)
        decisions = loaded.post("/decide/batch", json=body).json()["decisions"]
        assert calls(loaded) == before + 1
        assert [(d["source"], d["reason"]) for d in decisions] == [("guided", None)] * 3
        assert len({d["sensor_id"] for d in decisions}) == 3
        assert [d["tokens"]["completion"] for d in decisions] == [5, None, None]
        if decisions[0]["guided"]["calibrated"]:
            break
        # The server has one slot.
        measured(app)
    assert decisions[0]["guided"]["calibrated"]
    assert decisions[0]["tokens"]["cached"] > decisions[0]["tokens"]["static"]


def test_the_adapters_prompt_is_short_and_little_of_it_is_read_anew(report: Report) -> None:
    with ready(create_app(Settings(mode="llm", deadline_ms=60_000))) as edge:
        read = []
        for step in range(3):
            body = report(mission_id="compact", step=step)
            heard = {"queue": [52, 17, 33, 28, 60], "battery": [50.0] * 5, "channel_gain": [-90.0] * 5}
            body["sensors"] |= {**heard, "last_seen": [step] * 5, "x": [420.0, 650.0, 300.0, 520.0, 610.0]}
            answer = edge.post("/decide", json=body).json()
            assert (answer["source"], answer["reason"]) == ("llm", None)
            assert answer["tokens"]["completion"] == 1
            # The probabilities of the letters, by sensor.
            assert sum(kept["llm"] for kept in answer["top_k"]) == pytest.approx(1.0, abs=1e-3)
            read.append((answer["tokens"]["server_prompt"], answer["tokens"]["cached"]))
        assert calls(edge) == 3
    assert all(whole <= 130 for whole, _ in read), read
    assert all(whole - cached <= 70 for whole, cached in read[1:]), read


def calls(client: httpx.Client) -> float:
    """How often the LLM has decided."""
    lines = client.get("/metrics").text.splitlines()
    return sum(float(line.split()[-1]) for line in lines if line.startswith("aicvds_llm_requests_total"))


def test_decisions_and_health_go_on_while_the_model_loads(report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    gate = Gate()

    def slowly(*args: Any, **settings: Any) -> EmbeddedServer:
        gate.wait()
        return EmbeddedServer(*args, **settings)

    monkeypatch.setattr("service.llm.embedded.EmbeddedServer", slowly)
    app = create_app(Settings(deadline_ms=60_000))
    with serving(app) as url, httpx.Client(base_url=url, timeout=PATIENCE_S) as client, gate:
        until(lambda: gate.callers)
        assert client.get("/healthz").status_code == 200
        reported = client.get("/readyz").json()
        assert (reported["llm"], reported["detail"]) == ("loading", "the embedded LLM has not answered yet")
        assert client.post("/decide", json=report(mission_id="early")).json()["reason"] == "llm_loading"
        gate.open()
        wait_for(client, "ready")
        assert client.post("/decide", json=report(mission_id="early", step=1)).json()["reason"] is None


@pytest.mark.parametrize(("cores", "threads"), [(1, 1), (2, 2), (8, 8), (64, 8)])
def test_threads_default_to_one_for_each_core_up_to_eight(
    cores: int, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.config.settings.usable_cores", lambda: cores)
    assert Settings().embedded_threads == threads
    assert Settings(llm_threads=12).embedded_threads == 12
