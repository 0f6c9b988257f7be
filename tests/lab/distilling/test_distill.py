"""`python -m lab distill` on the real embedded model: small, resumed, written as GGUF, and served by llama.cpp."""

from __future__ import annotations

import asyncio
import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import httpx
import numpy as np
import pytest
import torch
from gguf import GGUFWriter
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from lab.commands.distill import main
from lab.distilling.adapter_training import train
from lab.distilling.batches import Batches
from lab.distilling.decision_student import DecisionStudent
from lab.distilling.distill import distill
from lab.distilling.examples import (
    EXPERIENCED,
    LEARNED,
    UNLEARNED,
    PromptExample,
    failing_signs,
)
from lab.distilling.examples_file import examples_of
from lab.distilling.gguf_adapter import write_gguf_adapter
from lab.distilling.loss import Outputs, Targets, answer_loss, loss_of
from lab.distilling.options import Distill
from lab.exploration.exploration import explore
from lab.exploration.rollouts import Header, write_rollouts
from service.config.settings import Settings
from service.llm.adapter_version import DECISIONS, PROMPT_VERSION, check_adapter
from service.llm.answers import Completion
from service.llm.calibration import probabilities
from service.llm.client import LLMClient
from service.llm.embedded import EmbeddedServer
from service.llm.model_file import embedded_model
from service.llm.request_bodies import label_body
from service.prompting.compact_prompt import STATIC
from tests.lab.distilling.conftest import SHORT, examples_in
from tests.support.waiting import PATIENCE_S

# Training takes a minute on idle cores.
pytestmark = pytest.mark.timeout(900)


@pytest.fixture(scope="module")
def distilled(rollouts: Path, tmp_path_factory: pytest.TempPathFactory, loaded_once: None) -> Path:
    out = tmp_path_factory.mktemp("runs") / "adapter"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lab.distilling.distill.EVALUATED", 4)
        distill(Distill(rollouts=(rollouts,), out=out, steps=3, batch=4, rank=2), Console(quiet=True))
    return out


def test_an_experience_and_a_row_of_one_sensor_have_one_sign(rollouts: Path) -> None:
    texts = [example.text for mission in examples_in(EXPERIENCED, rollouts) for example in mission]
    signs = [
        ({part[1] for part in re.findall(r"\d\D\d[XY]", text)}, set(re.findall(r"\d(\D)\d{7}[A-T]", text)))
        for text in texts
    ]
    assert any(past & shown for past, shown in signs)
    # Each prompt has drawn its signs from all of them.
    assert len(set().union(*(shown for _, shown in signs))) > 50


@given(st.lists(st.integers(1, 200), min_size=1, max_size=400), st.integers(1, 16))
def test_a_pass_has_each_example_at_most_once_and_batches_of_alike_lengths(lengths: list[int], size: int) -> None:
    batches, steps = Batches(lengths, size, seed=1), len(lengths) // size
    seen = [batches.of(step) for step in range(steps)]
    assert all(len(batch) == size for batch in seen)
    numbers = [number for batch in seen for number in batch]
    assert len(set(numbers)) == len(numbers)
    assert [batches.of(step) for step in range(steps)] == seen
    if steps <= 16:
        # One stretch: sorted, its batches do not overlap in length.
        spans = sorted((min(lengths[i] for i in batch), max(lengths[i] for i in batch)) for batch in seen)
        assert all(before[1] <= after[0] for before, after in pairwise(spans))


def test_the_examples_are_kept_and_every_eleventh_mission_is_held_out(rollouts: Path, tmp_path: Path) -> None:
    [found] = examples_of([rollouts], tmp_path)
    missions = [examples_in(view, rollouts) for view in (EXPERIENCED, LEARNED)]
    assert found.scenario == "paper"
    # The file's second mission has the cycle's second view, and its third the third.
    training = missions[0][1] + missions[1][2]
    assert [example.text for example in found.training] == [example.text for example in training]
    held = {name: [example.text for example in some] for name, some in found.held_out.items()}
    names = ("paper", "paper unlearned", "paper unlearned, experienced")
    views = (LEARNED, UNLEARNED, EXPERIENCED)
    assert held == {
        name: [example.text for example in examples_in(view, rollouts)[0]]
        for name, view in zip(names, views, strict=True)
    }
    [kept] = tmp_path.glob("examples-*.json.gz")
    written = kept.stat().st_mtime_ns
    [again] = examples_of([rollouts], tmp_path)
    assert kept.stat().st_mtime_ns == written
    assert [example.text for example in again.training] == [example.text for example in found.training]
    assert np.allclose(again.training[3].target, found.training[3].target)


def test_a_file_without_a_teacher_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "untaught.jsonl.gz"
    write_rollouts(file, Header(scenario=SHORT, missions=2, behaviour="test"), explore(SHORT, 60_000))
    assert main([str(file), "--out", str(tmp_path / "out")]) == 2
    assert "has no decision with a teacher" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--steps", "0"], "--steps 0 is not at least 1"),
        (["--rank", "65"], "--rank 65 is not between 1 and 64"),
        (["--learning-rate", "0"], "--learning-rate 0 is not above 0"),
        (["--threads", "-1"], "--threads -1 is below 0"),
    ],
)
def test_bad_options_are_named(
    options: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rollouts.jsonl.gz", "--out", str(tmp_path), *options]) == 2
    assert said in capsys.readouterr().err


def test_a_file_that_is_not_there_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "none.jsonl.gz"), "--out", str(tmp_path / "out")]) == 2
    assert "none.jsonl.gz" in capsys.readouterr().err


def test_without_the_embedded_model_the_remedy_is_named(
    rollouts: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("AICVDS_CACHE_DIR", str(tmp_path))
    assert main([str(rollouts), "--out", str(tmp_path / "out")]) == 2
    assert "aicvds model fetch" in capsys.readouterr().err


def test_the_loss_counts_only_offered_letters() -> None:
    example = PromptExample("U", "ABEF", np.array([0.5, 0.5, 0.0, 0.0]), (1, 1, 2, 2), 0)
    logits = torch.zeros(1, 20)
    logits[0, 2] = 50.0
    assert float(answer_loss(logits, Targets.of([example]))) == pytest.approx(np.log(4.0), abs=1e-5)


def test_the_loss_is_least_for_the_teachers_probabilities() -> None:
    examples = [
        PromptExample("U", "ABEF", np.array([0.1, 0.6, 0.2, 0.1]), (1, 1, 2, 2), 1),
        PromptExample("U", "AB", np.array([0.3, 0.7]), (4, 4), 1),
    ]
    targets = Targets.of(examples)
    assert targets.worth.tolist() == pytest.approx([0.7, 0.3, 1.0])
    perfect = Outputs(
        targets.answer.clamp(min=1e-9).log(),
        (targets.answer[targets.prompt] * targets.of_row).clamp(min=1e-9).log(),
        torch.logit(targets.worth.clamp(max=1.0 - 1e-6)),
    )
    torch.manual_seed(0)
    for part in ("answer", "rows", "worth"):
        other = replace(perfect, **{part: getattr(perfect, part) + torch.randn_like(getattr(perfect, part))})
        assert float(loss_of(other, targets)) > float(loss_of(perfect, targets)) + 0.01


@pytest.mark.long
def test_it_writes_an_adapter_for_llama_cpp_one_for_vllm_and_a_card(distilled: Path) -> None:
    check_adapter(distilled / "adapter.gguf", DECISIONS)
    assert (distilled / "peft" / "adapter_model.safetensors").is_file()
    card = json.loads((distilled / "card.json").read_text(encoding="utf-8"))
    assert (card["prompt_version"], card["steps"]) == (PROMPT_VERSION, 3)
    assert 15 < card["examples"] <= 30
    assert 0.0 <= card["held_out"]["paper unlearned, experienced"]["sensor"] <= 1.0


@pytest.mark.long
def test_an_adapter_goes_on_from_its_gguf_file(changed: tuple[DecisionStudent, Path], tmp_path: Path) -> None:
    assert main(["--begin", str(changed[1]), "--out", str(tmp_path)]) == 0
    # Its rank and its scale are the file's, and no number has moved to another place.
    assert (tmp_path / "adapter.gguf").read_bytes() == changed[1].read_bytes()
    again = DecisionStudent(embedded_model(Settings()), STATIC, 8, "cpu", tmp_path / "peft")
    for name, weight in changed[0].model.named_parameters():
        if "lora_" in name:
            assert torch.equal(again.model.get_parameter(name), weight.half().float()), name


def test_an_adapter_to_go_on_from_has_to_be_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "out")
    assert main(["--out", out]) == 2
    assert "name at least one file of `python -m lab explore`, or an adapter with --begin" in capsys.readouterr().err
    wrong = tmp_path / "wrong.gguf"
    wrong.write_bytes(b"GGUF of something else, but long enough to have a version")
    assert main(["--begin", str(wrong), "--out", out]) == 2
    assert f"{wrong} is no GGUF file" in capsys.readouterr().err
    write_gguf_model(model := tmp_path / "model.gguf")
    assert main(["--begin", str(model), "--out", out]) == 2
    assert f"{model} is no LoRA adapter" in capsys.readouterr().err
    write_gguf_adapter(empty := tmp_path / "empty.gguf", {}, DECISIONS, alpha=4.0, heads=9, kv_heads=3)
    assert main(["--begin", str(empty), "--out", out]) == 2
    assert f"{empty} is no LoRA adapter" in capsys.readouterr().err
    assert main(["--begin", str(tmp_path / "none.gguf"), "--out", out]) == 2
    assert "none.gguf" in capsys.readouterr().err


def write_gguf_model(path: Path) -> None:
    """Write a GGUF file that is a model and no adapter, without its tensors."""
    writer = GGUFWriter(path, "llama")
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()


@pytest.mark.long
@pytest.mark.usefixtures("loaded_once")
def test_an_adapter_of_another_model_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other.gguf"
    name = "base_model.model.model.layers.0.mlp.up_proj"
    weights = {
        f"{name}.lora_A.weight": np.ones((2, 64), np.float32),
        f"{name}.lora_B.weight": np.ones((96, 2), np.float32),
    }
    write_gguf_adapter(other, weights, DECISIONS, alpha=4.0, heads=9, kv_heads=3)
    assert main(["--begin", str(other), "--out", str(tmp_path / "out")]) == 2
    assert f"{other} is no adapter of SmolLM2-135M-Instruct.Q8_0.gguf" in capsys.readouterr().err


@pytest.fixture(scope="module")
def changed(distilled: Path) -> tuple[DecisionStudent, Path]:
    """A student whose adapter changes every answer, and its GGUF file."""
    student = DecisionStudent(embedded_model(Settings()), STATIC, 2, "cpu", distilled / "peft")
    large = 0
    torch.manual_seed(0)
    with torch.no_grad():
        for name, weight in student.model.named_parameters():
            # Three steps change little: a larger B shows that every matrix arrives at its place.
            if "lora_B" in name:
                weight += 0.5 * torch.randn_like(weight)
                large += 1
    assert large == 30 * 7
    adapter = distilled.parent / "large.gguf"
    student.write_gguf(adapter, DECISIONS)
    return student, adapter


@pytest.mark.long
def test_llama_cpp_gives_the_trained_probabilities(changed: tuple[DecisionStudent, Path], rollouts: Path) -> None:
    student, adapter = changed
    texts = [example.text for mission in examples_in(LEARNED, rollouts) for example in mission][::8]
    with torch.no_grad():
        trained = torch.softmax(student.outputs(texts).answer, dim=1).numpy()
    gguf = embedded_model(Settings())
    # llama.cpp's first draw decides whether its probabilities are among the labels or among all tokens.
    base, adapted = answered(gguf, None, texts, 1), answered(gguf, adapter, texts, 8)
    off, bare_off = (np.abs(found - trained[:, None]).max(axis=(1, 2)) for found in (adapted, base))
    # Both compute in a few bits, each in its own way: one answer of six is off by up to half of what the adapter
    # changes, their mean by a quarter. With the rows of one kind of matrix in another order the mean is as far off
    # as without the adapter.
    assert len(texts) == 6
    assert off.mean() < 0.5 * bare_off.mean(), (off, bare_off)


@pytest.mark.long
def test_a_request_without_the_adapter_is_answered_by_the_bare_model(changed: tuple[DecisionStudent, Path]) -> None:
    said: dict[str, list[str]] = {}
    for name, adapter in (("bare", None), ("adapted", changed[1])):
        server = EmbeddedServer(embedded_model(Settings()), threads=1, context=512, adapter=adapter)
        said[name] = []
        try:
            again = {"cache_prompt": False}
            for fields in ({}, server.without_adapter, again, server.without_adapter):
                body = {"messages": [{"role": "user", "content": "Say hello to Bob."}], "temperature": 0, **fields}
                answer = httpx.post(
                    f"{server.base_url}/chat/completions",
                    json=body | {"max_tokens": 12},
                    headers={"Authorization": f"Bearer {server.api_key}"},
                    timeout=PATIENCE_S,
                )
                said[name].append(answer.json()["choices"][0]["message"]["content"])
        finally:
            server.close()
    assert len(set(said["bare"])) == 1
    assert said["adapted"][0] == said["adapted"][2] != said["bare"][0]
    assert said["adapted"][1] == said["adapted"][3] == said["bare"][0]


def answered(gguf: Path, adapter: Path | None, texts: list[str], times: int) -> np.ndarray:
    """llama.cpp's probabilities of the twenty letters, read as the edge reads them, ``(texts, times, 20)``."""
    letters = list("ABCDEFGHIJKLMNOPQRST")
    server = EmbeddedServer(gguf, threads=1, context=512, adapter=adapter)

    async def ask() -> list[Completion]:
        client = LLMClient(server.base_url, api_key=server.api_key, trust_env=False)
        bodies = [label_body(None, STATIC, text, "grammar", [letters]) for text in texts]
        try:
            return [await client.complete(body) for body in bodies for _ in range(times)]
        finally:
            await client.close()

    try:
        answers = asyncio.run(asyncio.wait_for(ask(), PATIENCE_S))
    finally:
        server.close()
    found = [probabilities(answer, [letters])[0] for answer in answers]
    return np.array([[by_label[letter] for letter in letters] for by_label in found]).reshape(len(texts), times, 20)


@pytest.mark.long
@pytest.mark.usefixtures("loaded_once")
def test_an_interrupted_training_goes_on_to_the_same_weights(
    rollouts: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lab.distilling.adapter_training.CHECKPOINT_STEPS", 2)
    args = Distill(rollouts=(rollouts,), out=tmp_path, steps=4, batch=2, rank=1)
    [found] = examples_of([rollouts], tmp_path)
    examples = found.training

    def student() -> DecisionStudent:
        torch.manual_seed(0)
        return DecisionStudent(embedded_model(Settings()), STATIC, args.rank, "cpu")

    whole = list(train(student(), examples, args, tmp_path / "whole.pt"))
    assert len(whole) == 4
    begun = train(student(), examples, args, tmp_path / "half.pt")
    for _ in range(3):
        next(begun)
    begun.close()
    rest = list(train(student(), examples, args, tmp_path / "half.pt"))
    assert rest == pytest.approx(whole[2:])
    one, other = (torch.load(tmp_path / f"{name}.pt", weights_only=True)["weights"] for name in ("whole", "half"))
    assert all(torch.allclose(a, b) for a, b in zip(one, other, strict=True))
    with pytest.raises(ValueError, match="give --out another folder"):
        next(train(student(), examples, replace(args, seed=1), tmp_path / "half.pt"))


def test_a_sensor_fails_whose_newest_experience_is_a_failure_that_nobody_expected() -> None:
    assert failing_signs(["7d9X", "9a0Y", "0k9X", "5b9X", "5b0Y", "4c0Y", "4c9X"]) == {"d", "c"}
    assert failing_signs([]) == set()
