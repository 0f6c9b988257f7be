"""One HTTP client for every OpenAI-compatible server: OpenAI, vLLM, llama.cpp, Ollama, and the embedded one."""

from __future__ import annotations

import json
from typing import Any
from urllib.request import getproxies, proxy_bypass

import aiohttp
import httpx
from yarl import URL

from service.llm.answer_format import NoDecision
from service.llm.bounded_connections import BoundedConnector, allowing
from service.llm.completion import Completion, NotUnderstood, Unreachable, places_of

# No honest chat completion of two integers comes near this; an endless body must not fill the memory.
_MAX_RESPONSE_BYTES, _BYTES_A_PLACE = 256 * 1024, 8 * 1024
_MAX_TOKENS = 10**9
# A model's name stands in every decision's answer, log line and trace; the longest of real ones are paths.
_MAX_NAME = 200
# What servers answer to a field that they do not know; anything else says nothing about the field.
_NOT_UNDERSTOOD = (400, 404, 422)


class LLMClient:
    """Chat completions of one server. Time limits are the caller's: cancelling a call closes its connection.

    Args:
        base_url: up to and including ``/v1``.
        trust_env: heed ``HTTP_PROXY`` and its like.
    """

    def __init__(self, base_url: str, *, api_key: str | None = None, trust_env: bool = True) -> None:
        self.base_url = base_url
        # aiohttp takes apart what it is given as text, at each call.
        self._models, self._completions = (URL(f"{base_url}/{path}") for path in ("models", "chat/completions"))
        # Identity: a compressed answer of a few kilobytes could unpack to gigabytes before it is counted.
        headers = {"Accept-Encoding": "identity", "Content-Type": "application/json"}
        if api_key:
            headers["Authorization"] = f"Bearer {api_key}"
        # How many ask at once is bounded before; the certificates are those that httpx trusts.
        connector = BoundedConnector(limit=0, ssl=httpx.create_ssl_context(trust_env=trust_env))
        self._http = aiohttp.ClientSession(
            headers=headers,
            connector=connector,
            timeout=aiohttp.ClientTimeout(total=None, sock_connect=None),
            cookie_jar=aiohttp.DummyCookieJar(),
            auto_decompress=False,
        )
        # aiohttp itself would look for a proxy at each call, in a thread.
        self._by = _proxy_to(base_url) if trust_env else {}

    async def close(self) -> None:
        """Close every connection."""
        await self._http.close()

    async def models(self) -> list[str]:
        """Names of the models that the server lists, but for those that are no text, or longer than 200 characters.

        Raises:
            NoDecision: no list, or a list with nothing but such names.
        """
        listed = await self._call("GET", self._models, None)
        try:
            told = [model["id"] for model in listed["data"]]
        except (KeyError, TypeError):
            raise NoDecision("llm_error", f"{self.base_url}/models: no list of models") from None
        names = [n for n in told if isinstance(n, str) and n.isprintable() and len(n) <= _MAX_NAME]
        if told and not names:
            raise NoDecision("llm_error", f"{self.base_url}/models: no model has a name that can be used")
        return names

    async def complete(self, body: dict[str, Any]) -> Completion:
        """One chat completion of a whole request body; raises :class:`NoDecision`."""
        # Each token may come with its place's likeliest.
        most = max(_MAX_RESPONSE_BYTES, _BYTES_A_PLACE * body.get("max_tokens", 1))
        answer = await self._call("POST", self._completions, body, most)
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
        return Completion(text, prompt, cached, completion, places_of(answer["choices"][0]))

    async def _call(self, method: str, url: URL, body: dict[str, Any] | None, most: int = _MAX_RESPONSE_BYTES) -> Any:
        content = bytearray()
        sent = None if body is None else json.dumps(body, ensure_ascii=False, separators=(",", ":")).encode()
        try:
            with allowing(most):
                asked = await self._http.request(method, url, data=sent, allow_redirects=False, **self._by)
            async with asked as response:
                if response.headers.get("Content-Encoding", "identity") != "identity":
                    raise NoDecision("llm_error", f"{self.base_url}: compressed, though identity was asked for")
                async for chunk in response.content.iter_any():
                    content += chunk
                    if len(content) > most:
                        raise NoDecision("llm_error", f"{self.base_url}: more than {most} bytes")
        except aiohttp.ClientConnectorError as error:
            raise Unreachable("llm_error", f"{self.base_url}: {type(error).__name__}") from error
        except (aiohttp.ClientError, OSError, ValueError) as error:
            # Its text may quote the Authorization header.
            raise NoDecision("llm_error", f"{self.base_url}: {type(error).__name__}") from error
        if response.status in _NOT_UNDERSTOOD:
            raise NotUnderstood("llm_status", f"{self.base_url}: HTTP {response.status}")
        if response.status != 200:
            raise NoDecision("llm_status", f"{self.base_url}: HTTP {response.status}")
        try:
            return json.loads(content)
        except (ValueError, RecursionError):
            raise NoDecision("llm_error", f"{self.base_url}: a 200 that is not JSON") from None


def _proxy_to(url: str) -> dict[str, Any]:
    """How aiohttp is told of the proxy that the environment names for a URL, if it names one."""
    asked = httpx.URL(url)
    proxies = getproxies()
    named = proxies.get(asked.scheme) or proxies.get("all")
    if not named or proxy_bypass(asked.host):
        return {}
    proxy = httpx.URL(named if "://" in named else f"http://{named}")
    found: dict[str, Any] = {"proxy": str(proxy.copy_with(username=None, password=None))}
    if proxy.username:
        # Through a tunnel the server would see the request's own headers; without one the proxy sees no others.
        where = "proxy_headers" if asked.scheme == "https" else "headers"
        found[where] = {"Proxy-Authorization": aiohttp.encode_basic_auth(proxy.username, proxy.password)}
    return found
