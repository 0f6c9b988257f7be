"""What an LLM server can do: asked as the edge asks it, with one decision, timed."""

from dataclasses import dataclass

from service.config.settings import Settings
from service.llm.client import client_of
from service.llm.probing import Abilities, first_decision, probe
from service.llm.request_bodies import WarmUp


@dataclass(frozen=True, slots=True)
class Examination:
    """The abilities of a server, and one decision of it.

    Attributes:
        terms: changes of a request that it demands, in words.
        seconds: of the decision, with the static block in the prefix cache if the server has one.
        prompt_tokens, cached_tokens, completion_tokens: of the decision; None if the server does not count them.
    """

    abilities: Abilities
    terms: str
    seconds: float
    prompt_tokens: int | None
    cached_tokens: int | None
    completion_tokens: int | None


async def examine(settings: Settings, warm_up: WarmUp) -> Examination:
    """Examine the one server that the settings name.

    Raises:
        NoDecision: the server is gone, or its answer to the decision cannot be used; the text has its own words.
    """
    client = client_of(settings)
    try:
        able = await probe(client, settings.llm_model)
        answer, seconds = await first_decision(client, able.model, warm_up, able)
        counts = answer.prompt_tokens, answer.cached_tokens, answer.completion_tokens
        return Examination(able, str(client.terms), seconds, *counts)
    finally:
        await client.close()
