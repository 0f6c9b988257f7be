"""Every setting of the edge service; the environment variables have the prefix ``AICVDS_``."""

import json
import os
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, SecretStr, field_validator, model_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from shared.kit.cores import usable_cores
from shared.kit.validation_messages import suggestion
from shared.wire.schemas import Features, Mode, PromptFormat, Selection

# Upper bounds in tokens of the embedded model, which has one for each digit: of the static block, and of a row or an
# experience in each format.
_STATIC_TOKENS = 800
_ROW_TOKENS = {"csv": 44, "compact": 12}
# Of the two further columns of feature preset `reach`.
_REACH_TOKENS = 16
# The adapter that this package ships, if it ships one.
SHIPPED_ADAPTER = Path(__file__).parents[1] / "checkpoints" / "adapter.gguf"
# The orders' adapter, likewise.
SHIPPED_ORDERS = SHIPPED_ADAPTER.with_name("orders.gguf")
# The matrices of a small model are small, and the threads synchronise after each product. More than two threads were
# not measured.
_MOST_EMBEDDED_THREADS = 8
# Variables of earlier versions, and what replaces them.
_REMOVED = {"AICVDS_PROCESSES": ": several edges share one PostgreSQL behind a load balancer, or start one with --ray"}
# Variables of `aicvds simulate`, `aicvds mqtt` and docker-compose.yml, often in the same .env file.
_SIMULATORS = {
    f"AICVDS_{name}"
    for name in (
        *("API_KEY", "AWAIT_LLM", "BIND", "BUILD_NETWORK", "KEYS_DIR", "RUNS", "SCENARIO", "SEED", "USER"),
        *("LORAWAN_DIR", "MQTT_BROKER", "MQTT_PASSWORD", "READINGS_KEY", "WAIT_S"),
    )
}


def prompt_tokens(row_format: PromptFormat, rows: int, experiences: int, features: Features = "paper") -> int:
    """Upper bound of a prompt's length in the embedded model's tokens."""
    row = _ROW_TOKENS[row_format] + (_REACH_TOKENS if features == "reach" else 0)
    return _STATIC_TOKENS + row * (rows + experiences)


def _default_store() -> str:
    return str(Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state", "aicvds", "missions.db"))


def _json_object(value: object) -> object:
    if not isinstance(value, str):
        return value
    try:
        found = json.loads(value)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise ValueError('must be a JSON object, for example {"name": "value"}')
    return found


def _header_safe_texts(texts: dict[str, str]) -> dict[str, str]:
    for name, value in texts.items():
        if not (name.isascii() and name.isprintable() and value.isascii() and value.isprintable()):
            raise ValueError(f"{name[:40]!r}: name and value must be printable ASCII")
    return texts


JsonObject = Annotated[dict[str, Any], NoDecode, BeforeValidator(_json_object)]
JsonTexts = Annotated[dict[str, str], NoDecode, BeforeValidator(_json_object), AfterValidator(_header_safe_texts)]


class Settings(BaseSettings):
    """Settings of one edge service.

    Raises:
        pydantic.ValidationError: a variable has a bad value; the message names the field.
    """

    model_config = SettingsConfigDict(env_prefix="AICVDS_", frozen=True, extra="forbid", env_ignore_empty=True)

    # URL of an OpenAI-compatible server, with its /v1, or several, separated by commas. Unset: the embedded llama.cpp.
    llm_url: str | None = None
    # Name of the model, or one for each server. Unset: the first model that the server lists.
    llm_model: str | None = None
    # Bearer token for all servers, or one for each.
    llm_api_key: SecretStr | None = None
    # The order in which several servers are called: that of their URLs (`preference`), or one derived from the
    # mission's ID (`mission`), which keeps each mission at the server whose prefix cache has its prompts.
    llm_order: Literal["preference", "mission"] = "preference"
    # Concurrent calls of this edge to one of several servers before the next server gets them. 0: any number.
    llm_slots: int = Field(0, ge=0, le=10_000)
    # Name of a header with the mission's ID in each call for a decision, for a router that sends requests of one
    # session to one replica. Unset: none.
    llm_session_header: str | None = Field(None, pattern=r"^[A-Za-z0-9-]{1,64}$")
    # Further fields of each completion's body, a JSON object: {"reasoning_effort": "none"}, or
    # {"chat_template_kwargs": {"enable_thinking": false}}. They replace the edge's own of the same name.
    llm_extra_body: JsonObject = Field(default_factory=dict)
    # Further headers of each request to the server, a JSON object of texts: {"api-key": "..."} for Azure.
    llm_extra_headers: JsonTexts = Field(default_factory=dict, repr=False)
    # Further parameters of the server's URLs, a JSON object of texts: {"api-version": "preview"}.
    llm_extra_query: JsonTexts = Field(default_factory=dict, repr=False)
    # Most tokens that a model may think before its answer, allowed once an answer ends before it has begun. 0: none.
    llm_thinking_tokens: int = Field(2048, ge=0, le=131_072)
    # Seconds for which the first request may wait, while the server loads its model.
    llm_load_s: float = Field(300.0, ge=1, le=3600)
    # Milliseconds after which a second server, or the only one again, is called in addition to a server that has not
    # answered. 0: never. It doubles the work of a slow server, so it pays where there are several.
    hedge_ms: int = Field(0, ge=0, le=60_000)
    # Model file of the embedded llama.cpp. Unset: the one of `aicvds model fetch`.
    llm_gguf: Path | None = None
    # LoRA adapter of the embedded LLM, a GGUF file of `python -m lab distill`. Unset: the package's own, if it has one.
    # `off`: none. `served`: the server of AICVDS_LLM_URL applies it. Missions then have the adapter's own prompt.
    llm_adapter: str | None = None
    # LoRA adapter with which the embedded LLM reads operators' notes, a GGUF file of `python -m lab distill-orders`.
    # Unset: the package's own, if it has one. `off`: none.
    llm_orders: str | None = None
    # Threads of the embedded llama.cpp. 0: as many as cores, at most 8.
    llm_threads: int = Field(0, ge=0, le=256)
    # Tokens of the embedded model's context. Settings whose longest prompt does not fit are refused.
    llm_context: int = Field(4096, ge=512, le=131_072)

    # The default mode: `guided` (the LLM among other advisers), `llm` (the paper's method), `value` (the learned
    # modules) or `policy` (the planner). The last two start no LLM.
    mode: Mode = "guided"
    # Whether the policy without LLM plans or looks one step ahead.
    planner: Literal["on", "off"] = "on"
    # Milliseconds for one search for a plan; the best plan found by then counts.
    planner_ms: int = Field(500, ge=10, le=60_000)
    # Milliseconds from request to answer, unless the request has its own deadline. A third of the paper's 10 s step, so
    # that three UAVs that decide one after another fit into a step.
    deadline_ms: int = Field(3000, ge=10, le=60_000)
    # Sensors that the attention module selects for the prompt (k in the paper).
    top_k: int = Field(5, ge=1, le=100)
    # Experiences in the prompt before half of them are dropped; unset: 30 in the paper's prompt (mode `llm`), else 8.
    # An appended experience leaves the LLM's prefix cache valid. Dropping costs a prefill of the others, so it is rare.
    experiences: int | None = Field(None, ge=0, le=100)
    # The experiences in the prompt: `recent` ones, or the newest of each sensor, `failures` first.
    selection: Selection = "recent"
    # Adam's step size for the attention and velocity modules (the paper's table).
    learning_rate: float = Field(5e-4, gt=0, le=1)

    # US dollars for a million tokens, in the token accounting. 0: the embedded model costs nothing.
    price_input: float = Field(0.0, ge=0)
    price_cached: float = Field(0.0, ge=0)
    price_output: float = Field(0.0, ge=0)

    # Most decisions that wait for the LLM. The policy makes further ones: they would only share the LLM's time.
    llm_concurrency: int = Field(64, ge=1, le=10_000)
    # Address and port of `aicvds serve`. In a container the image sets both.
    host: str = "127.0.0.1"
    port: int = Field(8000, ge=0, le=65535)
    # Most concurrent requests; a further one gets a 503 with Retry-After. Several times `llm_concurrency`, so that the
    # policy decides before any request is refused.
    max_requests: int = Field(512, ge=1, le=100_000)
    # File of the accepted API keys (`aicvds keys add` makes it). Unset: requests need no key.
    keys: Path | None = None
    # Whether requests to an address other than loopback need no key.
    anonymous: Literal["on", "off"] = "off"
    # Names by which clients reach an edge without keys, separated by commas, besides this machine's own. `*`: any name,
    # where a proxy before the edge checks it.
    hosts: str = ""
    # Largest body in bytes, compressed or not, after decompression: 2,000 sensors take 0.08 to 0.16 MB.
    max_body_bytes: int = Field(2_000_000, ge=1_000, le=1_000_000_000)
    # Whether an LLM's answer must obey hard rules in mode `llm`: sensor in reach, battery not flat. The policy
    # overrides an answer that breaks one. `off` is the paper's method as published.
    verify: Literal["on", "off"] = "on"
    # The store of the missions: a SQLite file, or postgresql://user:password@host/database. `none`: memory alone.
    store: str = Field(default_factory=_default_store, min_length=1, repr=False)
    # With several edges on one PostgreSQL: the address to which the other edges redirect clients. Unset: from --host
    # and --port, with this machine's name in place of 0.0.0.0.
    advertise_url: str | None = None
    # Seconds for which this edge owns a mission of a PostgreSQL store without renewing the lease. After that, another
    # edge can take over the missions of a killed one.
    lease_s: float = Field(5.0, ge=1, le=300)
    # Most missions in memory and in the store; a further one is refused until another is deleted.
    max_missions: int = Field(1000, ge=1, le=1_000_000)
    # Whether a decision for a mission that does not exist makes it. `off`: only mission `default`, so that a mistyped
    # name is refused; PUT /missions/{id} makes the others.
    create_on_decide: Literal["on", "off"] = "off"
    # Folder of the model file and the token vocabulary.
    cache_dir: Path = Field(
        default_factory=lambda: Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "aicvds"
    )
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    # `text` for people, `json` (one object a line) for machines.
    log_format: Literal["text", "json"] = "text"

    @field_validator("llm_url")
    @classmethod
    def _http_url(cls, url: str | None) -> str | None:
        if url is None or url == "":
            return None
        return ",".join(_checked_url(one.strip()) for one in url.split(","))

    @field_validator("advertise_url")
    @classmethod
    def _reachable_url(cls, url: str | None) -> str | None:
        return None if url is None else _checked_url(url)

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
        experiences = 0 if self.adapted else self.most_experiences(self.mode)
        written: tuple[PromptFormat, Features] = ("compact", "reach") if self.adapted else ("csv", "paper")
        needed = prompt_tokens(written[0], self.top_k, experiences, written[1])
        if self.mode in ("llm", "guided") and needed > self.llm_context:
            raise ValueError(
                f"{experiences} experiences and {self.top_k} sensors need up to {needed} tokens: "
                f"raise AICVDS_LLM_CONTEXT (now {self.llm_context}) or lower AICVDS_EXPERIENCES"
            )
        return self

    def most_experiences(self, mode: Mode) -> int:
        """The most experiences in a prompt of this mode, unless the mission has its own number."""
        return (30 if mode == "llm" else 8) if self.experiences is None else self.experiences

    def each_server(self) -> "list[Settings]":
        """Settings with a single LLM server, for each server in the order of their URLs; raises ``ValueError``."""
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
    def embedded_adapter(self) -> Path | None:
        """The adapter file of the embedded LLM; None without one, and for an LLM server."""
        return self._embedded(None if self.llm_adapter == "served" else self.llm_adapter or SHIPPED_ADAPTER)

    @property
    def embedded_orders(self) -> Path | None:
        """The same for operators' notes."""
        return self._embedded(self.llm_orders or SHIPPED_ORDERS)

    def _embedded(self, named: str | Path | None) -> Path | None:
        if self.llm_url is not None or named is None or named == "off":
            return None
        # The package's adapters belong to the package's model.
        return Path(named) if isinstance(named, str) else named if self.llm_gguf is None and named.is_file() else None

    @property
    def adapted(self) -> bool:
        """Whether the LLM has an adapter, and so understands the compact prompt."""
        return self.llm_adapter == "served" or self.embedded_adapter is not None

    @property
    def embedded_threads(self) -> int:
        """Threads for the embedded llama.cpp: the setting, or a thread for each core, at most eight."""
        return self.llm_threads or min(usable_cores(), _MOST_EMBEDDED_THREADS)


def _checked_url(url: str) -> str:
    if not url.startswith(("http://", "https://")):
        raise ValueError("must start with http:// or https://, for example http://localhost:8080/v1")
    # Importing it takes a tenth of a second; an edge with the embedded LLM does not need it.
    import httpx

    try:
        parsed = httpx.URL(url)
    except (httpx.InvalidURL, ValueError):
        raise ValueError("is not a valid address") from None
    if parsed.userinfo or not parsed.host:
        raise ValueError("must name a host and no user: the key goes into AICVDS_LLM_API_KEY")
    if parsed.query or parsed.fragment or parsed.port not in (None, *range(1, 65_536)):
        raise ValueError("must end in a path, with a port up to 65535: a query goes into AICVDS_LLM_EXTRA_QUERY")
    return url.rstrip("/")


def _for_each(servers: int, name: str, value: str | None) -> list[str | None]:
    """The values of a variable for each server; a single value is for all servers."""
    values: list[str | None] = [one.strip() or None for one in value.split(",")] if value else [None]
    if len(values) not in (1, servers):
        raise ValueError(f"{name} names {len(values)} and AICVDS_LLM_URL {servers} servers: name one, or one for each")
    return values * servers if len(values) == 1 else values


def unknown_variables() -> dict[str, str]:
    """Environment variables with the settings' prefix that are not settings, mostly misspelled, each with a suggestion.

    A suggestion begins with a semicolon; it is empty if no setting has a similar name.
    """
    known = {f"AICVDS_{name.upper()}" for name in Settings.model_fields} | _SIMULATORS
    unknown = sorted(name for name in os.environ if name.startswith("AICVDS_") and name not in known)
    return {name: _REMOVED.get(name) or suggestion(name, known) for name in unknown}
