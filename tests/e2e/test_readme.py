"""The README is true: its curl works as pasted, its tables are the code's."""

import re
import subprocess
from pathlib import Path

import httpx
import pytest

from service.settings import Settings
from shared.wire import DecideResponse, Reason
from tests.e2e.processes import serving_edge

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def test_the_curl_works_as_pasted() -> None:
    [command] = re.findall(r"```sh\n(curl .*?)```", README, re.DOTALL)
    with serving_edge() as (url, _):
        pasted = command.strip().replace("http://localhost:8000", url)
        answered = subprocess.run(["bash", "-c", f"{pasted} --silent"], capture_output=True, text=True, check=True)
    decision = DecideResponse.model_validate_json(answered.stdout)
    assert decision.sensor_id in (0, 1, 2)


def test_every_setting_and_its_default_is_in_the_table() -> None:
    listed = dict(re.findall(r"^\| `(AICVDS_\w+)` \| ([^|]*?) ?\|", README, re.MULTILINE))
    assert listed.keys() == {f"AICVDS_{name.upper()}" for name in Settings.model_fields}
    defaults = Settings().model_dump(mode="json") | {"cache_dir": "~/.cache/aicvds"}
    for name, shown in listed.items():
        default = defaults[name.removeprefix("AICVDS_").lower()]
        if isinstance(default, int | float):
            assert float(shown) == default, name
        else:
            assert shown == (default or ""), name


def test_the_example_environment_has_the_real_defaults() -> None:
    lines = (ROOT / ".env.example").read_text()
    for name in ("top_k", "experiences", "deadline_ms", "llm_context", "max_missions", "max_body_bytes", "mode"):
        [shown] = re.findall(rf"^#AICVDS_{name.upper()}=(\S+)", lines, re.MULTILINE)
        assert shown == str(getattr(Settings(), name))


@pytest.mark.parametrize("reason", Reason.__args__)  # type: ignore[attr-defined]
def test_every_reason_is_explained(reason: str) -> None:
    assert f"`{reason}`" in README


def test_what_it_links_to_is_there() -> None:
    links = [link for link in re.findall(r"\]\(([^)#]+)", README) if not httpx.URL(link).is_absolute_url]
    assert links
    assert all((ROOT / link).exists() for link in links)
