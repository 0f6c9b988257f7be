"""A mission's complete spec: the service's settings and the mission's mode give the defaults."""

from typing import Literal, Self

from pydantic import Field

from service.config.settings import Settings
from shared.wire.schemas import LLM_MODES, Belief, Features, MissionSpec, Mode, PromptFormat, PromptStyle, Selection


class ResolvedPromptStyle(PromptStyle):
    """A prompt's style with all defaults filled in."""

    format: PromptFormat
    experiences: int = Field(ge=0)
    selection: Selection


class ResolvedSpec(MissionSpec):
    """A spec with all defaults filled in. The store writes it, so its fields are a file format."""

    mode: Mode
    top_k: int = Field(ge=1)
    features: Features
    belief: Belief
    planner: Literal["on", "off"]
    verify: Literal["on", "off"]
    prompt: ResolvedPromptStyle

    @classmethod
    def of(cls, spec: MissionSpec, settings: Settings) -> Self:
        """The spec, completed by the service's settings and the defaults of its mode."""
        mode = spec.mode or settings.mode
        row_format = spec.prompt.format or ("compact" if settings.adapted and mode in LLM_MODES else "csv")
        compact = row_format == "compact"
        # Mode `llm` is the paper's method, unless the spec or the adapter differs.
        as_published = mode == "llm" and not compact
        experiences = spec.prompt.experiences
        if experiences is None:
            experiences = 0 if compact else settings.most_experiences(mode)
        prompt = {
            "format": row_format,
            "experiences": experiences,
            # The adapter is trained on blocks that keep failures.
            "selection": spec.prompt.selection or ("failures" if compact else settings.selection),
        }
        resolved = {
            "mode": mode,
            "features": spec.features or ("paper" if as_published else "reach"),
            "belief": spec.belief or ("reported" if as_published else "fleet"),
            "top_k": spec.top_k or settings.top_k,
            "planner": spec.planner or settings.planner,
            "verify": spec.verify or settings.verify,
            "prompt": ResolvedPromptStyle.model_validate(dict(spec.prompt) | prompt),
        }
        return cls.model_validate(dict(spec) | resolved)

    @property
    def uses_llm(self) -> bool:
        """Whether the mode asks an LLM."""
        return self.mode in LLM_MODES

    @property
    def uses_attention(self) -> bool:
        """Whether attention prunes the state; mode ``value`` decides by its scores and always uses it."""
        return self.attention == "on" or self.mode == "value"
