"""`aicvds mission create`: the edge learns the world, and what is printed works as pasted."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from shared.wire.schemas import DecideRequest
from simulator.commands import mission
from tests.support.edge_stub import EdgeStub, stub_edge
from tests.support.places import ROOT

WORLD = ROOT / "examples" / "pipeline_world"


@pytest.fixture
def stub() -> Iterator[EdgeStub]:
    with stub_edge() as edge:
        yield edge


def test_the_edge_learns_the_world_and_the_request_fits_it(stub: EdgeStub, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["create", "--edge", stub.url, "--world", str(WORLD), "--mission", "line", "--note", "Visit 4 often."]
    assert mission.main(arguments) == 0
    spec = stub.missions["line"]
    assert spec.note == "Visit 4 often." and not isinstance(spec.scenario, str)
    printed = capsys.readouterr().out
    assert f"{stub.url}/?mission=line" in printed and '{"answer": "confirm"}' in printed
    [body] = re.findall(r"/decide .*? -d '(\{.*?\})'$", printed, re.MULTILINE | re.DOTALL)
    request = DecideRequest.model_validate_json(body)
    assert (request.mission_id, request.step) == ("line", 0)
    assert len(request.sensors.id) == spec.scenario.sensors
    assert "Authorization" not in printed


def test_a_key_stays_in_its_variable(
    stub: EdgeStub, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AICVDS_API_KEY", "aicvds_secret")
    assert mission.main(["create", "--edge", stub.url, "--note", "Visit 4 often."]) == 0
    printed = capsys.readouterr().out
    commands = [line for line in printed.splitlines() if line.startswith("curl ")]
    assert len(commands) == 4 and all("$AICVDS_API_KEY" in command for command in commands)
    assert "aicvds_secret" not in printed


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ([], 2, "usage: aicvds mission create"),
        (["make"], 2, "usage: aicvds mission create"),
        (["--help"], 0, "usage: aicvds mission create"),
        (["create"], 2, "--edge is missing"),
        (["create", "--edge", "http://e", "--scenario", "mars"], 2, "unknown scenario 'mars'"),
        (["create", "--edge", "http://127.0.0.1:1"], 1, "http://127.0.0.1:1"),
    ],
)
def test_bad_use(arguments: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert mission.main(arguments) == code
    printed = capsys.readouterr()
    assert said in printed.out + printed.err
