"""The HTTP client for every OpenAI-compatible server: OpenAI, vLLM, llama.cpp, Ollama, and the embedded one.

The bytes of one response are bounded: aiohttp itself reads response heads without limit, on the event loop.
"""

from __future__ import annotations

import functools
import json
import math
from contextvars import ContextVar
from typing import Any
from urllib.request import getproxies, proxy_bypass

import aiohttp
import httpx
from aiohttp.client_proto import ResponseHandler
from pydantic_core import to_json
from yarl import URL

from service.llm.answers import Completion, NoDecision, NotUnderstood, TokenPosition, Unreachable
from service.llm.request_bodies import TOP_LOGPROBS

# Far above any regular completion of two integers; an endless body must not fill the memory.
_MAX_RESPONSE_BYTES, _BYTES_A_TOKEN = 256 * 1024, 8 * 1024
# Bytes in addition to the body: heads (possibly several), chunk framing and trailers.
_MAX_HEAD_BYTES = 64 * 1024
_MAX_TOKENS, _MAX_POSITIONS = 10**9, 256
# Each decision's answer, log line and trace has the model's name; the longest real names are paths.
_MAX_NAME = 200
# The statuses by which servers refuse an unknown field; no other status says anything about the field.
_NOT_UNDERSTOOD = (400, 404, 422)
# Bytes of body that the answer to this task's request may have.
_ALLOWED: ContextVar[int] = ContextVar("allowed_body_bytes")


class LLMClient:
    """Chat completions of one server. Time limits are the caller's: cancelling a call closes its connection.

    Args:
        base_url: up to and including ``/v1``.
        trust_env: obey ``HTTP_PROXY`` and similar variables.
        session_header: name of a header with each completion's session; None: none.

    Raises:
        NoDecision: the environment names a proxy that cannot be used.
    """

    def __init__(
        self, base_url: str, *, api_key: str | None = None, trust_env: bool = True, session_header: str | None = None
    ) -> None:
        self.base_url = base_url
        # Found once: aiohttp would look for a proxy at each call, in a thread.
        self._proxy = _proxy_to(base_url) if trust_env else {}
        self._session_header = session_header
        # Parsed once: aiohttp would parse a string at each call.
        self._models, self._completions = (URL(f"{base_url}/{path}") for path in ("models", "chat/completions"))
        # Identity: a compressed answer of a few kilobytes could unpack to gigabytes before its size is checked.
        headers = {"Accept-Encoding": "identity", "Content-Type": "application/json"}
        if api_key:
            headers["Authorization"] = f"Bearer {api_key}"
        # The edge bounds its calls, so the connector need not; the certificates are those that httpx trusts.
        connector = _BoundedConnector(limit=0, ssl=httpx.create_ssl_context(trust_env=trust_env))
        self._http = aiohttp.ClientSession(
            headers=headers,
            connector=connector,
            timeout=aiohttp.ClientTimeout(total=None, sock_connect=None),
            cookie_jar=aiohttp.DummyCookieJar(),
            auto_decompress=False,
        )

    async def close(self) -> None:
        """Close every connection."""
        await self._http.close()

    async def models(self) -> list[str]:
        """The listed models' names, without unprintable ones and those of more than 200 characters.

        Raises:
            NoDecision: the server gives no list, or no name in it can be used.
        """
        answer = await self._call("GET", self._models, None)
        try:
            listed = [model["id"] for model in answer["data"]]
        except (KeyError, TypeError):
            raise NoDecision("llm_error", f"{self.base_url}/models: no list of models") from None
        names = [n for n in listed if isinstance(n, str) and n.isprintable() and len(n) <= _MAX_NAME]
        if listed and not names:
            raise NoDecision("llm_error", f"{self.base_url}/models: no model has a name that can be used")
        return names

    async def complete(self, body: dict[str, Any], session: str | None = None) -> Completion:
        """The chat completion of a request body; raises :class:`NoDecision`.

        Args:
            session: an ID shared by completions with a common prefix, which a router may send to the same server.
        """
        # Each token may come with the likeliest tokens of its position.
        most = max(_MAX_RESPONSE_BYTES, _BYTES_A_TOKEN * body.get("max_tokens", 1))
        answer = await self._call("POST", self._completions, body, most, session)
        try:
            text = answer["choices"][0]["message"]["content"]
            usage = answer.get("usage") or {}
            details = usage.get("prompt_tokens_details") or {}
            counts = (usage.get("prompt_tokens"), details.get("cached_tokens"), usage.get("completion_tokens"))
        except (AttributeError, KeyError, IndexError, TypeError):
            raise NoDecision("llm_error", f"{self.base_url}: a 200 that is no chat completion") from None
        if not isinstance(text, str):
            raise NoDecision("llm_error", f"{self.base_url}: a completion without text")
        prompt, cached, completion = (c if type(c) is int and 0 <= c <= _MAX_TOKENS else None for c in counts)
        if prompt is not None and cached is not None:
            cached = min(cached, prompt)
        return Completion(text, prompt, cached, completion, _positions(answer["choices"][0]))

    async def _call(
        self,
        method: str,
        url: URL,
        body: dict[str, Any] | None,
        most: int = _MAX_RESPONSE_BYTES,
        session: str | None = None,
    ) -> Any:
        content, options = bytearray(), self._proxy
        sent = None if body is None else to_json(body)
        if session is not None and self._session_header is not None:
            options = {**options, "headers": {**options.get("headers", {}), self._session_header: session}}
        try:
            allowed = _ALLOWED.set(most)
            try:
                request = await self._http.request(method, url, data=sent, allow_redirects=False, **options)
            finally:
                _ALLOWED.reset(allowed)
            async with request as response:
                if response.headers.get("Content-Encoding", "identity") != "identity":
                    raise NoDecision("llm_error", f"{self.base_url}: compressed, though identity was asked for")
                async for chunk in response.content.iter_any():
                    content += chunk
                    if len(content) > most:
                        raise NoDecision("llm_error", f"{self.base_url}: more than {most} bytes")
        except aiohttp.ClientConnectorError as error:
            raise Unreachable("llm_error", f"{self.base_url}: {type(error).__name__}") from error
        except (aiohttp.ClientError, OSError, ValueError) as error:
            # The error's text is left out: it may quote the Authorization header.
            raise NoDecision("llm_error", f"{self.base_url}: {type(error).__name__}") from error
        if response.status in _NOT_UNDERSTOOD:
            raise NotUnderstood("llm_status", f"{self.base_url}: HTTP {response.status}")
        if response.status != 200:
            raise NoDecision("llm_status", f"{self.base_url}: HTTP {response.status}")
        try:
            return json.loads(content)
        except (ValueError, RecursionError):
            raise NoDecision("llm_error", f"{self.base_url}: a 200 that is not JSON") from None


def _positions(choice: Any) -> tuple[TokenPosition, ...]:
    """The readable positions of an answer: OpenAI's ``top_logprobs``, or llama.cpp's ``top_probs``."""
    found: list[TokenPosition] = []
    try:
        for position in choice["logprobs"]["content"][:_MAX_POSITIONS]:
            likeliest = _probabilities(position.get("top_logprobs") or position.get("top_probs") or [])
            found.append(TokenPosition(str(position.get("token", "")), likeliest))
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError):
        pass
    return tuple(found) if any(position.likeliest for position in found) else ()


def _probabilities(likeliest: Any) -> dict[str, float]:
    found: dict[str, float] = {}
    for entry in likeliest[: 4 * TOP_LOGPROBS]:
        probability = entry["prob"] if "prob" in entry else math.exp(min(0.0, entry["logprob"]))
        # A NaN, in either field, is no probability.
        known = 0.0 <= probability <= 1.0 and not math.isnan(entry.get("logprob", 0.0))
        if isinstance(entry["token"], str) and known:
            token = entry["token"].strip()
            found[token] = min(1.0, found.get(token, 0.0) + float(probability))
    return found


def _proxy_to(url: str) -> dict[str, Any]:
    """aiohttp's arguments for the proxy that the environment names for a URL; empty if it names none."""
    target = httpx.URL(url)
    proxies = getproxies()
    named = proxies.get(target.scheme) or proxies.get("all")
    if not named or proxy_bypass(target.host):
        return {}
    try:
        proxy = httpx.URL(named if "://" in named else f"http://{named}")
    except httpx.InvalidURL as error:
        raise NoDecision("llm_error", f"the proxy of the environment is no address: {error}") from None
    if proxy.scheme not in ("http", "https"):
        fix = "unset ALL_PROXY, or name an http:// proxy"
        raise NoDecision("llm_error", f"a {proxy.scheme[:20]} proxy of the environment cannot be used: {fix}")
    found: dict[str, Any] = {"proxy": str(proxy.copy_with(username=None, password=None))}
    if proxy.username:
        # Through a tunnel the server would see the request's own headers; without one the proxy sees no others.
        where = "proxy_headers" if target.scheme == "https" else "headers"
        found[where] = {"Proxy-Authorization": aiohttp.encode_basic_auth(proxy.username, proxy.password)}
    return found


class _TooMuch(aiohttp.ClientConnectionError):
    """The server sent more bytes than an answer may have."""


class _BoundedConnector(aiohttp.TCPConnector):
    """Makes connections that are aborted past ``_ALLOWED`` bytes of a request's body and 64 KB of heads."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        # aiohttp has no public argument for the class that reads a connection.
        kind: type[ResponseHandler] = _BoundedResponse
        self._factory = functools.partial(kind, loop=self._loop)


class _BoundedResponse(ResponseHandler):
    _left = 0

    def set_response_params(self, **params: Any) -> None:
        """Called by aiohttp as a request begins, in that request's task."""
        self._left = _ALLOWED.get() + _MAX_HEAD_BYTES
        super().set_response_params(**params)

    def data_received(self, data: bytes) -> None:
        self._left -= len(data)
        if self._left >= 0 or self.transport is None:
            super().data_received(data)
            return
        error = _TooMuch()
        self.set_exception(error)
        if self._payload is not None:
            self._payload.set_exception(error)
        # An idle connection is closed too: a server could send unrequested bytes without end.
        self.transport.abort()
