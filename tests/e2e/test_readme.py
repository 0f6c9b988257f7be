"""The README and the docs are true: their curl works as pasted, their tables are the code's."""

import json
import re
import subprocess

import httpx
import pytest

from service.config.settings import Settings
from shared.planning.guidance_messages import GuidanceStatus
from shared.wire.reasons import Reason
from shared.wire.schemas import DecideResponse
from tests.conftest import Edge
from tests.support.places import ROOT
from tests.support.processes import serving_edge
from tests.support.waiting import until

README, DECIDING, OPERATOR, SETTINGS = (
    (ROOT / page).read_text()
    for page in ("README.md", "docs/reference/deciding.md", "docs/guides/operator.md", "docs/reference/settings.md")
)


def curls(page: str) -> str:
    """A page's one block of them."""
    [block] = re.findall(r"```sh\n(curl .*?)```", page, re.DOTALL)
    return str(block).strip()


DECIDE, GUIDE = curls(README), curls(OPERATOR)


def pasted(command: str, url: str) -> str:
    """What a curl prints."""
    at_edge = command.replace("http://localhost:8000", url)
    return subprocess.run(["bash", "-c", f"{at_edge} --silent"], capture_output=True, text=True, check=True).stdout


def test_the_curl_works_as_pasted(edge: Edge) -> None:
    decision = DecideResponse.model_validate_json(pasted(DECIDE, str(edge().base_url)))
    assert decision.sensor_id in (0, 1, 2)


@pytest.mark.long
def test_a_note_is_understood_and_confirmed_as_pasted() -> None:
    put, get, confirm, own = re.split(r"\n(?=curl)", GUIDE)
    with serving_edge() as (url, _):
        json.loads(pasted(put, url))
        until(lambda: GuidanceStatus.model_validate_json(pasted(get, url)).status != "compiling")
        reported = GuidanceStatus.model_validate_json(pasted(get, url))
        assert reported.status == "proposed" and reported.guidance is not None, reported.failure
        assert [wish.model_dump() for wish in reported.guidance.sensors] == [
            {"sensor_id": 4, "weight": 1.0, "visit_every": 3}
        ]
        assert GuidanceStatus.model_validate_json(pasted(confirm, url)).status == "confirmed"
        given = GuidanceStatus.model_validate_json(pasted(own, url))
    assert (given.status, given.origin) == ("confirmed", "operator")


def test_every_setting_and_its_default_is_in_the_table() -> None:
    listed = dict(re.findall(r"^\| `(AICVDS_\w+)` \| ([^|]*?) ?\|", SETTINGS, re.MULTILINE))
    assert listed.keys() == {f"AICVDS_{name.upper()}" for name in Settings.model_fields}
    defaults = Settings().model_dump(mode="json") | {
        "cache_dir": "~/.cache/aicvds",
        "store": "~/.local/state/aicvds/missions.db",
    }
    for name, shown in listed.items():
        default = defaults[name.removeprefix("AICVDS_").lower()]
        if isinstance(default, int | float):
            assert float(shown) == default, name
        else:
            assert shown == (default or ""), name


def test_the_example_environment_has_the_real_defaults() -> None:
    lines = (ROOT / ".env.example").read_text()
    for name in ("top_k", "deadline_ms", "llm_context", "max_missions", "max_body_bytes", "mode"):
        [shown] = re.findall(rf"^#AICVDS_{name.upper()}=(\S+)", lines, re.MULTILINE)
        assert shown == str(getattr(Settings(), name))


@pytest.mark.parametrize("reason", Reason.__args__)  # type: ignore[attr-defined]
def test_every_reason_is_explained(reason: str) -> None:
    assert f"`{reason}`" in DECIDING


def test_what_it_links_to_is_there() -> None:
    links = [link for link in re.findall(r"\]\(([^)#]+)", README) if not httpx.URL(link).is_absolute_url]
    assert links
    assert all((ROOT / link).exists() for link in links)
