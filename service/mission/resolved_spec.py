"""A mission's spec in full: what its maker left open, settled by the service's settings and by its mode."""

from __future__ import annotations

from typing import TypeVar

from service.config.settings import Settings
from shared.wire import MissionSpec

T = TypeVar("T")


def in_full(spec: MissionSpec, settings: Settings) -> MissionSpec:
    """A spec with the service's settings, and what follows from its mode, where it says nothing."""
    mode = spec.mode or settings.mode
    # The paper's method as it is written, unless asked otherwise.
    written = mode == "llm"
    told = spec.prompt.experiences
    prompt = {
        "experiences": settings.experiences if told is None else told,
        "selection": spec.prompt.selection or settings.selection,
    }
    return spec.model_copy(
        update={
            "mode": mode,
            "features": spec.features or ("paper" if written else "reach"),
            "belief": spec.belief or ("reported" if written else "fleet"),
            "top_k": spec.top_k or settings.top_k,
            "planner": spec.planner or settings.planner,
            "verify": spec.verify or settings.verify,
            "prompt": spec.prompt.model_copy(update=prompt),
        }
    )


def required(value: T | None) -> T:
    """A field that a spec in full has; raises ``TypeError`` for one that has not."""
    if value is None:
        raise TypeError("this spec is not in full")
    return value
