from pathlib import Path

import pytest
from pydantic import ValidationError

from service.settings import Settings, usable_cores


@pytest.mark.parametrize(("quota", "cores"), [("100000 100000", 1), ("50000 100000", 1), ("99900000 100000", None)])
def test_a_containers_quota_counts(tmp_path: Path, quota: str, cores: int | None) -> None:
    (tmp_path / "cpu.max").write_text(f"{quota}\n")
    assert usable_cores(tmp_path / "cpu.max") == (cores or usable_cores(tmp_path / "none"))


def test_no_quota_is_no_limit(tmp_path: Path) -> None:
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert usable_cores(tmp_path / "cpu.max") == usable_cores(tmp_path / "none") >= 1


@pytest.mark.parametrize("url", ["localhost:8080", "ftp://host/v1", "http:/host"])
def test_an_llm_url_must_be_one(url: str) -> None:
    with pytest.raises(ValidationError, match="llm_url"):
        Settings(llm_url=url)


def test_a_trailing_slash_makes_no_difference() -> None:
    assert Settings(llm_url="http://host/v1/").llm_url == "http://host/v1"
