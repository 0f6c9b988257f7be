"""The connection to one LLM server or to the embedded LLM: its client, its model's names and its abilities."""

import asyncio
import logging
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

from service.config.settings import Settings
from service.llm.answers import Completion, NoDecision
from service.llm.embedded import Embed, EmbeddedServer
from service.llm.probing import Abilities, first_decision, probe, probe_body
from service.llm.request_bodies import WarmUp

if TYPE_CHECKING:
    from service.llm.client import LLMClient

log = logging.getLogger(__name__)

PROBE_TIMEOUT_S = 60.0


class Connection:
    """Reaches or loads an LLM, probes it, and sends requests to it.

    Args:
        warm_up: the first request.
        embed: loads the embedded LLM.

    Attributes:
        client: None before the LLM is reached or loaded.
        model, bare_model: name of the model, once it is known, with its adapter and without.
        notes_model: name of the model that reads notes.
        reads_letters: whether that model has the orders' adapter, which reads notes whose numbers are letters.
        abilities: the result of the probes.
        decision_s: duration of the last probe's decision; 0 before it.
    """

    def __init__(self, settings: Settings, warm_up: WarmUp, embed: Embed) -> None:
        self._settings = settings
        self._warm_up = warm_up
        self._embed = embed
        self.client: LLMClient | None = None
        self._embedded: EmbeddedServer | None = None
        self.model = self.bare_model = self.notes_model = settings.llm_model
        self.reads_letters = False
        self.abilities = Abilities()
        self.decision_s = 0.0

    def __str__(self) -> str:
        """The abilities and the changes of requests that the server demands, in words."""
        terms = "" if self.client is None else str(self.client.terms)
        return f"{self.abilities}; with {terms}" if terms else str(self.abilities)

    @property
    def embedded(self) -> bool:
        """Whether the LLM is the embedded one, once it is loaded."""
        return self._embedded is not None

    async def close(self) -> None:
        """Close the connections, and free the embedded model."""
        if self.client is not None:
            await self.client.close()
        if self._embedded is not None:
            await asyncio.to_thread(self._embedded.close)

    async def open(self) -> None:
        """Reach or load the LLM, unless that is done, and probe its abilities and a decision.

        Raises:
            NoDecision, TimeoutError: no server answers.
            ModelMissing, AdapterUnusable, LoadFailed: there is no embedded LLM.
        """
        # In a thread: importing aiohttp takes a fifth of a second.
        settings, client_module = self._settings, await asyncio.to_thread(import_module, "service.llm.client")
        if self.client is None and settings.llm_url is not None:
            self.client = client_module.client_of(settings)
        elif self.client is None:
            self._embedded = await self._embed(settings)
            key = self._embedded.api_key
            self.client = client_module.LLMClient(self._embedded.base_url, api_key=key, trust_env=False)
            self.model = self.model or self._embedded.model
            self.bare_model = self.bare_model or self._embedded.bare_model
            self.notes_model = self.notes_model or self._embedded.notes_model
            self.reads_letters = bool(self._embedded.with_orders)
        async with asyncio.timeout(settings.llm_load_s):
            await self._find_abilities()
        try:
            await self._judge()
        except (NoDecision, TimeoutError) as error:
            log.warning("the LLM's answer to the first question cannot be used: %s", error or "none in time")
        else:
            if self.decision_s * 1e3 > settings.deadline_ms:
                text = "LLM too slow: a decision took %.2f s, the deadline is %d ms"
                log.warning(text, self.decision_s, settings.deadline_ms)

    async def ping(self) -> None:
        """Send a short request; raises :class:`NoDecision` or ``TimeoutError``."""
        async with asyncio.timeout(self._settings.llm_load_s):
            await self._reached().complete(probe_body(self.model, self.abilities.constraint))

    async def probe_again(self) -> None:
        """Probe the abilities and a decision; raises :class:`NoDecision` or ``TimeoutError``."""
        async with asyncio.timeout(self._settings.llm_load_s):
            await self._find_abilities()
        await self._judge()

    async def _find_abilities(self) -> None:
        """Ask the server for its model, unless the settings or the model file name one, and for its abilities."""
        given = self.model if self.embedded else self._settings.llm_model
        self.abilities = await probe(self._reached(), given)
        if given is None:
            self.model = self.bare_model = self.notes_model = self.abilities.model

    async def _judge(self) -> None:
        """Send the warm-up, and check its answer as a decision's; raises :class:`NoDecision` or ``TimeoutError``."""
        enough_s = self._settings.deadline_ms / 1e3
        async with asyncio.timeout(PROBE_TIMEOUT_S):
            _, self.decision_s = await first_decision(
                self._reached(), self.model, self._warm_up, self.abilities, enough_s
            )

    async def complete(self, body: dict[str, Any], mission_id: str | None) -> Completion:
        """The answer to a decision's request; raises :class:`NoDecision`."""
        client, embedded = self._reached(), self._embedded
        if embedded is None:
            return replace(await client.complete(body, mission_id), model=self.model, url=self._settings.llm_url)
        with embedded.request(body["messages"][0]["content"], self._warm_up.static) as fields:
            answer = await client.complete(body | fields)
        return replace(answer, model=self.bare_model if "lora" in fields else self.model)

    async def complete_note(self, body: dict[str, Any]) -> Completion:
        """The answer to a request about a note; raises :class:`NoDecision`."""
        client = self._reached()
        if self._embedded is None:
            return replace(await client.complete(body), model=self.model)
        with self._embedded.note_request() as fields:
            return replace(await client.complete(body | fields), model=self.notes_model)

    def _reached(self) -> "LLMClient":
        if self.client is None:
            raise NoDecision("llm_unavailable", "the LLM is not reached yet")
        return self.client
