"""``aicvds serve --processes 2``: one port, and each mission decided by its own process."""

from __future__ import annotations

import json
import uuid
from pathlib import Path

import httpx
import psutil
import pytest

from service.storage.locks import FileLock, StoreUnusable
from tests.e2e.processes import output_until, run, run_here, started
from tests.e2e.shared_out import NAMES, Report, first_event, outlive_a_kill, serving, sockets
from tests.support.waiting import PATIENCE_S, until
from tests.unit.service.stub_llm import wait_for

pytestmark = pytest.mark.usefixtures("made_on_decide")


def test_every_mission_is_decided_by_its_own_process(tmp_path: Path, report: Report) -> None:
    with serving(tmp_path / "m.db") as edge, httpx.Client(base_url=edge.url, timeout=PATIENCE_S) as client:
        assert "libtorch" not in Path(f"/proc/{edge.parent.pid}/maps").read_text()
        decided: dict[str, list[str]] = {name: [] for name in NAMES}
        # One connection for both missions, back and forth.
        for step in range(3):
            for name in NAMES:
                answer = client.post("/decide", json=report(mission_id=name, step=step)).raise_for_status().json()
                assert answer["stored"]
                decided[name].append(answer["decision_id"])
        # Where the first glance at a request names the wrong mission, it moves once more.
        for first, last in (NAMES, NAMES[::-1]):
            twice = json.dumps(report(mission_id=last, step=2, uav_id=1)).replace("{", f'{{"mission_id": "{first}",', 1)
            answer = client.post("/decide", content=twice, headers={"Content-Type": "application/json"})
            assert answer.json()["mission_id"] == last
        for name in NAMES:
            outcome = {"decision_id": decided[name][0], "cost": 0.5}
            assert client.post("/feedback", json={**outcome, "mission_id": name}).json()["result"] == "applied"
            # The process that knows the decision answers, whichever is asked.
            assert client.post("/feedback", json=outcome).json()["result"] == "duplicate"
            assert client.get(f"/missions/{name}").json()["decisions"] == 4
            assert client.get(f"/missions/{name}/decisions/{decided[name][2]}/prompt").json()["state"]
            assert name in first_event(client, name)
        assert client.post("/feedback", json={"decision_id": uuid.uuid4().hex, "cost": 0.5}).status_code == 404
        listed = client.get("/missions").json()
        assert {line["mission_id"]: line["decisions"] for line in listed["missions"]} == dict.fromkeys(NAMES, 4)
        assert listed["newest"] == NAMES[0] and listed["more"] == 0
        metrics = client.get("/metrics").text
        for process in "01":
            assert f'aicvds_missions{{process="{process}"}} 1.0' in metrics
            assert f'aicvds_decisions_total{{process="{process}",reason="mode_value",source="value"}} 4.0' in metrics
        assert client.delete(f"/missions/{NAMES[0]}").status_code == 204
        assert client.get(f"/missions/{NAMES[0]}").status_code == 404
        assert set(edge.deciding()) == {0, 1}
        children = edge.parent.children(recursive=True)
        folder = next(path.parent for path in sockets(edge.deciding()[0]) if path.suffix == ".moved")
        assert folder.stat().st_mode & 0o777 == 0o700
    assert not psutil.wait_procs(children, PATIENCE_S)[1]
    assert not folder.exists()


@pytest.mark.long
def test_a_killed_process_loses_nothing_and_the_others_go_on(tmp_path: Path, report: Report) -> None:
    with serving(tmp_path / "m.db") as edge:
        outlive_a_kill(edge, report)


@pytest.mark.long
def test_all_have_one_embedded_llm_and_outlive_it(tmp_path: Path, report: Report) -> None:
    with (
        serving("none", AICVDS_MODE="llm", AICVDS_LLM_ADAPTER="off") as edge,
        httpx.Client(base_url=edge.url, timeout=PATIENCE_S) as client,
    ):
        wait_for(client, "ready")

        def reasons(step: int) -> list[str | None]:
            return [client.post("/decide", json=report(mission_id=n, step=step)).json()["reason"] for n in NAMES]

        away = {"llm_loading", "llm_unavailable", "llm_timeout"}
        assert not away & set(reasons(0))
        deciding = {child.pid for child in edge.deciding().values()}
        (llm,) = (child for child in edge.parent.children() if child.pid not in deciding)
        llm.kill()
        # The first calls end with the connection that they find.
        until(lambda: reasons(1) == ["llm_unavailable"] * 2)
        wait_for(client, "ready")
        assert not away & set(reasons(2))


@pytest.mark.long
def test_missions_go_on_in_one_process_after_the_parent_was_killed(tmp_path: Path, report: Report) -> None:
    """With keys, which hold for every process."""
    store, keys = tmp_path / "m.db", str(tmp_path / "keys.json")
    key = run_here("keys", "add", "fleet", "--file", keys, "--scopes", "decide", "admin").stdout.strip()
    env = {"AICVDS_STORE": str(store), "AICVDS_KEYS": keys, "AICVDS_MODE": "value", "AICVDS_DEADLINE_MS": "60000"}
    with (
        started("serve", "--port", "0", AICVDS_PROCESSES="2", **env) as process,
        httpx.Client(timeout=PATIENCE_S) as client,
    ):
        client.base_url = httpx.URL(output_until(process, r"listening on (http://[\d.:]+)")[1])
        until(lambda: client.get("/readyz").status_code == 200)
        for name in NAMES:
            assert client.post("/decide", json=report(mission_id=name)).status_code == 401
        client.headers["Authorization"] = f"Bearer {key}"
        for name in NAMES:
            assert client.post("/decide", json=report(mission_id=name)).json()["stored"]
        assert client.get("/metrics").text.count("aicvds_missions{") == 2
        listed = client.get("/missions").json()
        assert len(listed["missions"]) == 2 and listed["may_command"]
        with pytest.raises(StoreUnusable, match="another edge"):
            FileLock(str(store))
        children = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        assert not psutil.wait_procs(children, PATIENCE_S)[1]
    with serving(store, 1) as edge, httpx.Client(base_url=edge.url, timeout=PATIENCE_S) as client:
        listed = client.get("/missions").json()
        assert {line["mission_id"] for line in listed["missions"]} == set(NAMES)
        for name in NAMES:
            assert client.post("/decide", json=report(mission_id=name, step=1)).status_code == 200
            assert client.get(f"/missions/{name}").json()["decisions"] == 2


def test_what_keeps_the_processes_from_starting_is_one_clear_line(tmp_path: Path) -> None:
    far = tmp_path / ("x" * 100)
    far.mkdir()
    lock = FileLock(str(tmp_path / "m.db"))
    for env, said in (
        ({"TMPDIR": str(far)}, "set TMPDIR to a shorter one"),
        ({"AICVDS_STORE": str(tmp_path / "m.db")}, "AICVDS_STORE: another edge uses"),
        ({"AICVDS_STORE": "/proc/nowhere/m.db"}, "AICVDS_STORE: "),
    ):
        refused = run("serve", "--port", "0", "--processes", "2", **env)
        assert refused.returncode == 2
        assert said in refused.stderr and "Traceback" not in refused.stderr
    lock.close()
    assert not list(far.iterdir())


@pytest.mark.parametrize("processes", ["0", "65", "two"])
def test_a_number_of_processes_that_cannot_be_is_refused(processes: str) -> None:
    refused = run("serve", "--port", "0", "--processes", processes)
    assert refused.returncode == 2
    assert "processes" in (refused.stderr + refused.stdout).lower()
    assert json.dumps(refused.stderr).count("Traceback") == 0
