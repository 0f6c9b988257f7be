import gzip
from pathlib import Path

import pytest

from service.settings import Settings
from service.tokens import TokenCounter, price_usd
from service.vocabulary import VocabularyDamaged, ensure_vocabulary


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
    monkeypatch.setattr("service.vocabulary.files", lambda _: package)
    with pytest.raises(VocabularyDamaged):
        ensure_vocabulary(tmp_path / "cache")
    assert not (tmp_path / "cache").exists()


def test_price() -> None:
    settings = Settings(price_input=0.15, price_cached=0.075, price_output=0.6)
    assert price_usd(settings, 1000, 800, 5) == pytest.approx((200 * 0.15 + 800 * 0.075 + 5 * 0.6) / 1e6)
