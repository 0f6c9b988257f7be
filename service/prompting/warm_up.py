"""The warm-up request of an LLM server, with the static block of a mission of default settings."""

from service.config.settings import Settings
from service.llm.request_bodies import WarmUp
from service.prompting.compact_prompt import CompactTemplate
from service.prompting.guided_prompt import GuidedTemplate
from service.prompting.paper_prompt import Template
from shared.world.scenario import SCENARIOS


def warm_up(settings: Settings) -> WarmUp:
    """The request in the service's mode; it fills the server's prefix cache."""
    paper = SCENARIOS["paper"]
    if settings.adapted:
        compact = CompactTemplate(paper, rows=settings.top_k)
        return WarmUp(compact.static, "999999U9a9999999A", compact.labels)
    if settings.mode == "guided":
        guided = GuidedTemplate(
            paper, rows=settings.top_k, experiences=settings.most_experiences("guided"), ranked=True
        )
        return WarmUp(guided.static, guided.content_free()[0], guided.labels)
    template = Template(paper, experiences=settings.most_experiences("llm"))
    return WarmUp(template.static, "UAV at 500,500\n0,50,50,-90,100,1,60,40\n", None)
