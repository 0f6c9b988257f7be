"""`lab distill-orders` on the real embedded model: small, resumed, written as GGUF, and served beside decisions."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path
from typing import Any

import httpx
import pytest
import torch
from rich.console import Console

from lab.commands.distill_orders import main
from lab.distilling.adapter_training import train
from lab.distilling.distill_orders import distill_orders
from lab.distilling.note_examples import note_examples
from lab.distilling.note_student import NoteStudent
from lab.distilling.options import DistillOrders
from service.config.settings import SHIPPED_ADAPTER, Settings
from service.guidance.lettered_orders import STATIC, grammar
from service.guidance.note_numbers import LetteredNote
from service.llm.adapter_version import ORDERS, check_adapter
from service.llm.embedded import EmbeddedServer
from service.llm.model_file import embedded_model
from tests.support.waiting import PATIENCE_S

pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]


@pytest.fixture(scope="module")
def distilled(tmp_path_factory: pytest.TempPathFactory, loaded_once: None) -> Path:
    out = tmp_path_factory.mktemp("runs") / "orders"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lab.distilling.distill_orders.EVALUATED", 8)
        distill_orders(DistillOrders(out=out, steps=3, batch=4, rank=2), Console(quiet=True))
    return out


def test_the_folder_has_the_adapter_and_its_card(distilled: Path) -> None:
    check_adapter(distilled / "adapter.gguf", ORDERS)
    card = json.loads((distilled / "card.json").read_text())
    assert (card["orders_version"], card["steps"], card["held_out_phrasings"]["notes"]) == (ORDERS.number, 3, 8)


@pytest.mark.usefixtures("loaded_once")
def test_a_loss_of_some_steps_falls_and_a_training_goes_on_where_it_was(tmp_path: Path) -> None:
    args = DistillOrders(out=tmp_path, steps=8, batch=4, rank=2, learning_rate=3e-3)
    examples = list(islice(note_examples(7), 4))
    student = NoteStudent(embedded_model(Settings()), STATIC, 2, "cpu")
    losses = list(train(student, examples, args, tmp_path / "checkpoint.pt"))
    assert losses[-1] < 0.9 * losses[0]
    assert list(train(student, examples, args, tmp_path / "checkpoint.pt")) == []


def test_both_adapters_are_in_one_server_and_each_answers_its_own_requests(distilled: Path, tmp_path: Path) -> None:
    student = NoteStudent(embedded_model(Settings()), STATIC, 2, "cpu", distilled / "peft")
    torch.manual_seed(0)
    with torch.no_grad():
        for name, weight in student.model.named_parameters():
            if "lora_B" in name:
                weight += 0.5 * torch.randn_like(weight)
    orders = tmp_path / "large.gguf"
    student.write_gguf(orders, ORDERS)
    note = LetteredNote.of("Visit sensor 4 every third step, and not over 9 m/s.", 0)
    said = {
        name: answers(note, *files) for name, files in {"two": (SHIPPED_ADAPTER, orders), "none": (None, None)}.items()
    }
    bare, decision, of_note, bare_again = said["two"]
    assert bare == bare_again == said["none"][0]
    assert len({bare, decision, of_note}) == 3


def answers(note: LetteredNote, adapter: Path | None, orders: Path | None) -> list[str]:
    """A server's answers by the bare model, as to a decision, as to a note, and by the bare model again."""
    server = EmbeddedServer(embedded_model(Settings()), threads=1, context=512, adapter=adapter, orders=orders)

    def ask(fields: dict[str, Any]) -> str:
        body = {"messages": [{"role": "system", "content": STATIC}, {"role": "user", "content": note.text}]}
        answer = httpx.post(
            f"{server.base_url}/chat/completions",
            json={**body, "temperature": 0, "max_tokens": 12, "grammar": grammar(note), "logprobs": True, **fields},
            headers={"Authorization": f"Bearer {server.api_key}"},
            timeout=PATIENCE_S,
        )
        # The first token's probability says more than the text.
        return str(answer.json()["choices"][0]["logprobs"]["content"][0]["logprob"])

    again = {"cache_prompt": False}
    try:
        return [ask(one | again) for one in (server.without_adapter, {}, server.with_orders, server.without_adapter)]
    finally:
        server.close()


def test_a_usage_error_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["--out", str(tmp_path), "--steps", "0"]) == 2
    assert capsys.readouterr().err == "python -m lab distill-orders: --steps 0 is not at least 1\n"
