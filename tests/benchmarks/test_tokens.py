"""benchmarks/tokens.py at its smallest: a short mission, its prompts counted and put to the real embedded model."""

from typing import Any

import pytest

from tests.benchmarks.running import figures

pytestmark = pytest.mark.long


_BLOCKS = ("o200k", "o200k_static", "o200k_experiences", "o200k_state")
SMALLEST = ("--seeds", "1", "--steps", "4", "--asked", "1", "--policy", "eof")


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return figures("benchmarks.tokens", *SMALLEST, out=tmp_path_factory.mktemp("tokens") / "tokens.json")


@pytest.mark.timeout(600)
def test_the_edges_prompts_are_shorter_than_the_papers(found: Any) -> None:
    tokens = found["tokens"]
    for way in ("guided", "llm"):
        ours, theirs = tokens[way], tokens["paper"]
        assert ours["ratio"]["own"][0] == pytest.approx(ours["own"]["mean"] / theirs["own"]["mean"])
        assert ours["ratio"]["own"][0] < 0.8
        assert ours["ratio"]["new"][0] < 0.5
        assert ours["new"]["mean"] < ours["own"]["mean"]
    whole, *blocks = (tokens["paper"][name]["mean"] for name in _BLOCKS)
    assert whole == pytest.approx(sum(blocks))


@pytest.mark.timeout(600)
def test_the_papers_state_block_is_about_as_long_as_the_paper_states(found: Any) -> None:
    stated = found["state_tokens_stated_by_the_paper"]
    assert 0.85 * stated < found["tokens"]["paper"]["o200k_state"]["mean"] < 1.1 * stated


@pytest.mark.timeout(600)
def test_the_server_reads_what_was_reckoned(found: Any) -> None:
    asked = found["asked"]
    assert asked["decisions"] == 2
    for way in ("guided", "llm", "paper"):
        assert asked[way]["new_as_reckoned"] == 1.0
        assert asked["lost_packets_above_best"][way]["mean"] >= 0.0
