"""Every setting of the edge service, in one place. Environment variables carry the prefix ``AICVDS_``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, SecretStr, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from service.config.cores import usable_cores
from service.config.prompt_budget import prompt_tokens
from shared.wire import Mode, Selection


def _default_cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "aicvds"


def _default_store() -> str:
    home = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    return str(home / "aicvds" / "missions.db")


# Read by `aicvds simulate` and docker-compose.yml, often from the same .env file.
_SIMULATORS = {
    f"AICVDS_{name}"
    for name in (
        *("API_KEY", "AWAIT_LLM", "BIND", "BUILD_NETWORK", "KEYS_DIR", "PORT", "RUNS", "SCENARIO", "SEED", "USER"),
        "WAIT_S",
    )
}


class Settings(BaseSettings):
    """Settings of one edge service.

    Raises:
        pydantic.ValidationError: a variable is out of bounds; the message names the field.
    """

    model_config = SettingsConfigDict(env_prefix="AICVDS_", frozen=True, extra="forbid", env_ignore_empty=True)

    # An OpenAI-compatible server, up to and including /v1, or several in order of preference, divided by commas.
    # Unset: the embedded llama.cpp.
    llm_url: str | None = None
    # The model to ask for, or one for each server. Unset: the first that the server lists.
    llm_model: str | None = None
    # Sent as a bearer token: to all servers, or one for each.
    llm_api_key: SecretStr | None = None
    # Milliseconds after which a second server (or the only one, again) is asked beside one that has not answered.
    # 0: none is. It doubles what a slow server has to do, so it pays where there are several.
    hedge_ms: int = Field(0, ge=0, le=60_000)
    # Another model file for the embedded llama.cpp. Unset: the one that `aicvds model fetch` brought.
    llm_gguf: Path | None = None
    # Threads of the embedded llama.cpp. 0: cores - 1, because with as many threads as cores and
    # anything else running, llama.cpp's spinning workers slow each token a hundredfold.
    llm_threads: int = Field(0, ge=0, le=256)
    # Tokens of the embedded model's context; the settings are refused where the longest prompt would not fit.
    llm_context: int = Field(4096, ge=512, le=131_072)

    # Who decides by default: `guided` (the LLM among other advisers), `llm` (the paper's method), `value` (what the
    # modules learned) or `policy` (the planner); with the last two no LLM is started.
    mode: Mode = "guided"
    # Whether the LLM-free policy plans (extra `planner`) or looks one step ahead.
    planner: Literal["on", "off"] = "on"
    # Milliseconds that one search for a plan may take; the best plan until then counts.
    planner_ms: int = Field(500, ge=10, le=60_000)
    # Milliseconds from request to answer unless the request says otherwise. A third of the paper's 10 s
    # step, so that three UAVs deciding one after another still fit into it.
    deadline_ms: int = Field(3000, ge=10, le=60_000)
    # Sensors that the attention module keeps for the prompt (k in the paper).
    top_k: int = Field(5, ge=1, le=100)
    # Experiences in the prompt before half of them are dropped. Appending keeps the LLM's prefix
    # cache; dropping costs one prefill of what stays, so it happens rarely.
    experiences: int = Field(8, ge=0, le=200)
    # Which of them stay: `recent`, those `similar` to the present state, or the `best` and a few of the worst.
    selection: Selection = "recent"
    # Adam's step size for the attention and velocity modules (the paper's table).
    learning_rate: float = Field(5e-4, gt=0, le=1)

    # US dollars a million tokens, for the price in the token accounting. 0: the embedded model costs nothing.
    price_input: float = Field(0.0, ge=0)
    price_cached: float = Field(0.0, ge=0)
    price_output: float = Field(0.0, ge=0)

    # Decisions that may wait for the LLM at once. More would only share its time: they are the policy's at once.
    llm_concurrency: int = Field(64, ge=1, le=10_000)
    # Requests in hand at once; one more is answered 503 with Retry-After. Several times `llm_concurrency`, so that
    # decisions go to the policy before any is refused.
    max_requests: int = Field(512, ge=1, le=100_000)
    # File of the keys that requests must carry (`aicvds keys add` makes it); unset: everyone may ask.
    keys: Path | None = None
    # Whether everyone may ask who reaches an address other than loopback.
    anonymous: Literal["on", "off"] = "off"
    # Largest body in bytes, compressed or not, after decompression: 10,000 sensors take 0.4 to 0.8 MB.
    max_body_bytes: int = Field(2_000_000, ge=1_000, le=1_000_000_000)
    # Whether an LLM's answer must keep hard rules in mode `llm`: in reach, battery not flat. What breaks one is
    # overridden by the policy; `off` is the paper's method as it is written.
    verify: Literal["on", "off"] = "on"
    # Where missions outlive the process: a SQLite file, or postgresql://user:password@host/database. `none`: nowhere.
    store: str = Field(default_factory=_default_store, min_length=1, repr=False)
    # Missions held at once, in memory or in the store; one more is refused until another is deleted.
    max_missions: int = Field(1000, ge=1, le=1_000_000)
    # Where the model file and the token vocabulary live.
    cache_dir: Path = Field(default_factory=_default_cache)
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    # `text` for people, `json` (an object a line) for machines.
    log_format: Literal["text", "json"] = "text"

    @field_validator("llm_url")
    @classmethod
    def _http_url(cls, url: str | None) -> str | None:
        if url is None or url == "":
            return None
        return ",".join(_checked_url(one.strip()) for one in url.split(","))

    @field_validator("llm_api_key")
    @classmethod
    def _header_safe(cls, key: SecretStr | None) -> SecretStr | None:
        if key is None:
            return None
        # A key read from a file ends in a newline.
        stripped = key.get_secret_value().strip()
        if not (stripped.isascii() and stripped.isprintable()):
            raise ValueError("must be printable ASCII")
        return SecretStr(stripped)

    @model_validator(mode="after")
    def _one_for_each_server(self) -> Self:
        self.each_server()
        return self

    @model_validator(mode="after")
    def _prompt_fits(self) -> Self:
        needed = prompt_tokens("csv", self.top_k, self.experiences)
        if needed > self.llm_context:
            raise ValueError(
                f"{self.experiences} experiences and {self.top_k} sensors need up to {needed} tokens: "
                f"raise AICVDS_LLM_CONTEXT (now {self.llm_context}) or lower AICVDS_EXPERIENCES"
            )
        return self

    def each_server(self) -> list[Settings]:
        """These settings for each LLM server by itself, in order of preference; raises ``ValueError``."""
        if self.llm_url is None:
            return [self]
        urls = self.llm_url.split(",")
        models = _for_each(len(urls), "AICVDS_LLM_MODEL", self.llm_model)
        key = None if self.llm_api_key is None else self.llm_api_key.get_secret_value()
        keys = _for_each(len(urls), "AICVDS_LLM_API_KEY", key)
        return [
            self.model_copy(update={"llm_url": url, "llm_model": model, "llm_api_key": SecretStr(one) if one else None})
            for url, model, one in zip(urls, models, keys, strict=True)
        ]

    @property
    def embedded_threads(self) -> int:
        """Threads for the embedded llama.cpp: the setting, or cores - 1, at least 1."""
        return self.llm_threads or max(1, usable_cores() - 1)


def _checked_url(url: str) -> str:
    if not url.startswith(("http://", "https://")):
        raise ValueError("must start with http:// or https://, for example http://localhost:8080/v1")
    # A tenth of a second to import, which an edge with its own LLM does without.
    import httpx

    try:
        parsed = httpx.URL(url)
    except (httpx.InvalidURL, ValueError):
        raise ValueError("is not a valid address") from None
    if parsed.userinfo or not parsed.host:
        raise ValueError("must name a host and no user: the key goes into AICVDS_LLM_API_KEY")
    return url.rstrip("/")


def _for_each(servers: int, name: str, given: str | None) -> list[str | None]:
    """One for each server, or the same for all of them."""
    several: list[str | None] = [one.strip() or None for one in given.split(",")] if given else [None]
    if len(several) not in (1, servers):
        raise ValueError(f"{name} names {len(several)} and AICVDS_LLM_URL {servers} servers: name one, or one for each")
    return several * servers if len(several) == 1 else several


def unknown_variables() -> list[str]:
    """Variables of the environment that look like settings and are none: typing errors, mostly."""
    known = {f"AICVDS_{name.upper()}" for name in Settings.model_fields} | _SIMULATORS
    return sorted(name for name in os.environ if name.startswith("AICVDS_") and name not in known)
