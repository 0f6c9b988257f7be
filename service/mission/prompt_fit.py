"""A mission's prompt template, whether the LLM's context is large enough for its prompts, and the LLM's warm-up."""

from dataclasses import dataclass

from service.config.settings import Settings, prompt_tokens
from service.errors import Refused
from service.llm.request_bodies import WarmUp
from service.mission.resolved_spec import ResolvedSpec
from service.prompting.candidates import MOST_LABELS
from service.prompting.compact_prompt import CompactTemplate
from service.prompting.guided_prompt import GuidedTemplate
from service.prompting.paper_prompt import Template
from service.prompting.prompt import note_block
from shared.world.scenario import SCENARIOS, Scenario


def template_for(spec: ResolvedSpec, scenario: Scenario) -> Template:
    """The template of the mission's mode."""
    experiences, note = spec.prompt.experiences, spec.note
    ranked = spec.uses_attention and spec.prompt.order == "score"
    rows = spec.top_k if spec.uses_attention else scenario.sensors
    if spec.prompt.format == "compact":
        return CompactTemplate(scenario, rows=rows)
    if spec.mode == "guided":
        return GuidedTemplate(scenario, rows=rows, experiences=experiences, ranked=ranked, note=note)
    return Template(scenario, spec.features, experiences=experiences, ranked=ranked, note=note)


@dataclass(frozen=True, slots=True)
class PromptFit:
    """The size of a mission's prompts against the LLM's context.

    Attributes:
        context: tokens of the LLM's context.
        adapted: whether the LLM has the adapter that the compact prompt needs.
    """

    spec: ResolvedSpec
    scenario: Scenario
    context: int
    adapted: bool

    def fits(self, uavs: int = 1) -> bool:
        """Whether the LLM understands the prompt, and its context is large enough for one about this many UAVs."""
        understood = self.adapted or not self._compact
        return understood and self._needed(uavs) <= self.context and (uavs == 1 or not self._compact)

    def check(self) -> None:
        """Raises ``Refused`` if the LLM cannot use a prompt about one UAV."""
        style = self.spec.prompt
        if self._compact and not self.adapted:
            raise Refused(
                "prompt.format",
                "compact needs an LLM with an adapter: leave AICVDS_LLM_ADAPTER unset for the embedded LLM's, "
                "or set it to `served` where your LLM server applies it",
            )
        if self._rows > MOST_LABELS and not self.spec.uses_attention and (self._compact or self.spec.mode == "guided"):
            raise Refused(
                "attention",
                f"a prompt with letters has at most {MOST_LABELS} sensors, not all {self._rows}: leave it on",
            )
        if self.fits():
            return
        raise Refused(
            "prompt",
            f"{style.experiences} experiences and {self._rows} sensors as {style.format} need up to {self._needed()} "
            f"tokens and AICVDS_LLM_CONTEXT is {self.context}: raise it, or lower prompt.experiences or top_k",
        )

    def _needed(self, uavs: int = 1) -> int:
        """The most tokens that a prompt can have."""
        style = self.spec.prompt
        needed = prompt_tokens(style.format, self._rows * uavs, style.experiences, self.spec.features)
        # A tokenizer makes at most one token of each byte. The compact prompt has no text of the note.
        return needed + (0 if self._compact else len(note_block(self.spec.note).encode()))

    @property
    def _compact(self) -> bool:
        return self.spec.prompt.format == "compact"

    @property
    def _rows(self) -> int:
        return min(self.scenario.sensors, self.spec.top_k) if self.spec.uses_attention else self.scenario.sensors


def warm_up(settings: Settings) -> WarmUp:
    """The warm-up request with the static block of a mission of default settings; it fills the prefix cache."""
    paper = SCENARIOS["paper"]
    if settings.adapted:
        compact = CompactTemplate(paper, rows=settings.top_k)
        return WarmUp(compact.static, "963458U9h0998009A7d4798089E7e4000009I7c4007009M7a4005009Q", compact.labels)
    if settings.mode == "guided":
        guided = GuidedTemplate(
            paper, rows=settings.top_k, experiences=settings.most_experiences("guided"), ranked=True
        )
        return WarmUp(guided.static, guided.content_free()[0], guided.labels)
    template = Template(paper, experiences=settings.most_experiences("llm"))
    return WarmUp(template.static, "UAV at 500,500\n0,50,50,-90,100,1,60,40\n", None)
