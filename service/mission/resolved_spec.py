"""A mission's spec in full: what its maker left open, settled by the service's settings and by its mode."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field

from service.config.settings import Settings
from shared.wire import Belief, Features, MissionSpec, Mode, PromptStyle, Selection


class ResolvedPromptStyle(PromptStyle):
    """A prompt's style in which nothing is left open."""

    experiences: int = Field(ge=0)
    selection: Selection


class ResolvedSpec(MissionSpec):
    """A spec in which nothing is left open. The store keeps it, so its fields are a file format."""

    mode: Mode
    top_k: int = Field(ge=1)
    features: Features
    belief: Belief
    planner: Literal["on", "off"]
    verify: Literal["on", "off"]
    prompt: ResolvedPromptStyle

    @classmethod
    def of(cls, spec: MissionSpec, settings: Settings) -> Self:
        """A spec with the service's settings, and what follows from its mode, where it says nothing."""
        mode = spec.mode or settings.mode
        # The paper's method as it is written, unless asked otherwise.
        written = mode == "llm"
        told = spec.prompt.experiences
        prompt = {
            "experiences": settings.experiences if told is None else told,
            "selection": spec.prompt.selection or settings.selection,
        }
        settled = {
            "mode": mode,
            "features": spec.features or ("paper" if written else "reach"),
            "belief": spec.belief or ("reported" if written else "fleet"),
            "top_k": spec.top_k or settings.top_k,
            "planner": spec.planner or settings.planner,
            "verify": spec.verify or settings.verify,
            "prompt": ResolvedPromptStyle.model_validate(dict(spec.prompt) | prompt),
        }
        return cls.model_validate(dict(spec) | settled)
