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
    # Where so few sensors are heard at the start, the form of mode llm differs only by its attention.
    for way, most, most_new in (("guided", 0.5, 0.6), ("llm", 1.01, 1.01)):
        ours, theirs = tokens[way], tokens["paper"]
        assert ours["ratio"]["own"][0] == pytest.approx(ours["own"]["mean"] / theirs["own"]["mean"])
        assert ours["ratio"]["own"][0] <= most
        assert ours["ratio"]["new"][0] <= most_new
        assert ours["new"]["mean"] < ours["own"]["mean"]
    whole, *blocks = (tokens["paper"][name]["mean"] for name in _BLOCKS)
    assert whole == pytest.approx(sum(blocks))


@pytest.mark.timeout(600)
def test_the_state_block_by_step_is_longer_with_more_sensors(found: Any) -> None:
    by_step = found["state_tokens_by_step"]
    for step, (all_sensors, _) in by_step["all"].items():
        # The waypoint, and ten rows of 16 tokens, fewer where a sensor was not heard.
        assert by_step["llm"][step][0] <= by_step["paper"][step][0] < all_sensors < 8 + 10 * 17


@pytest.mark.timeout(600)
def test_the_server_reads_what_was_reckoned(found: Any) -> None:
    asked = found["asked"]
    assert asked["decisions"] == 2
    for way in ("guided", "llm", "paper"):
        assert asked[way]["new_as_reckoned"] == 1.0
        assert asked["lost_packets_above_best"][way]["mean"] >= 0.0
