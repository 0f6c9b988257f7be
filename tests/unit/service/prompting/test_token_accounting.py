import gzip
import os
import random
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import tiktoken

from service.config.settings import Settings
from service.prompting.token_accounting import TokenCounter, price_usd
from service.prompting.tokenizer import VocabularyDamaged, encoding, ensure_vocabulary
from service.prompting.unpruned_state import UnprunedState
from shared.wire.schemas import Features, MissionSpec
from shared.world.scenario import Scenario
from tests.support.missions import attended, mission, uav, written_rows

COUNTER = TokenCounter(Settings().cache_dir)


def test_counts_as_gpt_4o_mini_does_without_a_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_network(*_: object, **__: object) -> None:
        raise AssertionError("tiktoken asked the network")

    monkeypatch.setattr("requests.get", no_network)
    monkeypatch.setattr("tiktoken.registry.ENCODINGS", {})
    counter = TokenCounter(tmp_path)
    assert counter.count("") == 0
    assert counter.count("hello world") == 2
    assert counter.count("3,52,98,-83,0,106\n") == 12
    # A prompt is data: what looks like a control token is counted as text, not obeyed and not refused.
    assert counter.count("<|endoftext|>") > 1


def test_a_damaged_vocabulary_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "package"
    (package / "data").mkdir(parents=True)
    (package / "data" / "o200k_base.tiktoken.gz").write_bytes(gzip.compress(b"IQ== 0\n"))
    monkeypatch.setattr("service.prompting.tokenizer.files", lambda _: package)
    with pytest.raises(VocabularyDamaged):
        ensure_vocabulary(tmp_path / "cache")
    assert not (tmp_path / "cache").exists()


def test_what_an_earlier_start_packed_counts_alike_and_is_packed_anew_where_it_is_damaged(tmp_path: Path) -> None:
    text = "3,52,98,-83,0,106\nOutput one pair, sensor_id velocity: <|endoftext|>"
    parsed = encoding(tmp_path)
    (packed,) = (tmp_path / "tiktoken").glob("*.msgpack")
    whole = packed.read_bytes()
    # It alone will do.
    (tmp_path / "tiktoken" / "fb374d419588a4632f3f557e76b4b70aebbca790").unlink()
    again = encoding(tmp_path)
    assert again.encode_ordinary(text) == parsed.encode_ordinary(text)
    assert (again.name, again.special_tokens_set) == (parsed.name, parsed.special_tokens_set)
    for damaged in (b"", whole[:1000], whole[:-1] + b"!"):
        packed.write_bytes(damaged)
        assert encoding(tmp_path).encode_ordinary(text) == parsed.encode_ordinary(text)
        assert packed.read_bytes() == whole


def test_a_folder_that_cannot_be_written_to_is_read(tmp_path: Path) -> None:
    ensure_vocabulary(tmp_path)
    # A folder where the new file would be written to first.
    (tmp_path / "tiktoken" / f"o200k_base-{tiktoken.__version__}.{os.getpid()}").mkdir()
    assert len(encoding(tmp_path).encode_ordinary("hello world")) == 2
    assert not list((tmp_path / "tiktoken").glob("*.msgpack"))


def test_price() -> None:
    settings = Settings(price_input=0.15, price_cached=0.075, price_output=0.6)
    assert price_usd(settings, 1000, 800, 5) == pytest.approx((200 * 0.15 + 800 * 0.075 + 5 * 0.6) / 1e6)


def test_every_number_of_up_to_three_digits_is_one_token_and_longer_ones_are_split_by_three() -> None:
    assert [COUNTER.count(str(n)) for n in range(1000)] == [1] * 1000
    assert [COUNTER.count("7" * digits) for digits in range(1, 11)] == [1, 1, 1, 2, 2, 2, 3, 3, 3, 4]


@pytest.mark.parametrize("features", get_args(Features))
def test_the_uncompressed_state_is_counted_as_if_it_were_written(features: Features) -> None:
    """Numbers of 1 to 7 digits, zeros, negative ones and unknown ones, with lines above them and without."""
    spec = MissionSpec.model_validate(
        {
            "scenario": Scenario(sensors=300, queue_capacity=100_000, area_m=1e6),
            "features": features,
        }
    )
    m = mission(spec)
    drawn = random.Random(features)
    queue = [None if drawn.random() < 0.3 else float(int(10 ** drawn.uniform(0, 5)) - 1) for _ in range(300)]
    view = attended(m, uav(step=3000, x=[10 ** drawn.uniform(0, 6) for _ in queue], queue=queue), 3000)
    experiences = [f"{n},{n * n},-{n * 7},5,{n % 11} > {n} 9: {n / 10}\n" for n in range(0, 30_000, 977)]
    prompt = m.template.prompt(view.state, view.shown(), experiences)
    tokens, lines = COUNTER.account(prompt), written_rows(view.state)
    assert len(lines) == 300
    assert tokens.experiences == COUNTER.count(prompt.experiences)
    assert tokens.state_uncompressed == COUNTER.count(prompt.uncompressed.head + "".join(lines))
    assert (prompt.kept, tokens.state) == (view.shown(), COUNTER.count(prompt.state))
    assert COUNTER.account(replace(prompt, kept=None)) == tokens
    assert UnprunedState(view.state).tokens_by_row(COUNTER.count).tolist() == [COUNTER.count(line) for line in lines]
