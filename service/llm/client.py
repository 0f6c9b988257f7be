"""The HTTP client for every OpenAI-compatible server: OpenAI, vLLM, llama.cpp, Ollama, and the embedded one.

The bytes of one response are bounded: aiohttp itself reads response heads without limit, on the event loop.
"""

import functools
import json
import logging
import time
from collections.abc import Mapping
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any
from urllib.request import getproxies, proxy_bypass

import aiohttp
import httpx
from aiohttp.client_proto import ResponseHandler
from pydantic_core import to_json
from yarl import URL

from service.config.settings import Settings
from service.llm.answer_reading import completion_of, connection_fault, excerpt, excerpt_of, pause_of, streamed
from service.llm.answers import Busy, Completion, NoDecision, NotUnderstood, Unreachable
from service.llm.request_bodies import RequestExtras, RequestTerms

# Far above any regular completion of two integers; an endless body must not fill the memory.
_MAX_RESPONSE_BYTES, _BYTES_A_TOKEN = 256 * 1024, 8 * 1024
# Bytes in addition to the body: heads (possibly several), chunk framing and trailers.
_MAX_HEAD_BYTES = 64 * 1024
# Each decision's answer, log line and trace has the model's name; the longest real names are paths.
_MAX_NAME = 200
# The statuses by which servers refuse an unknown field; no other status says anything about the field.
_NOT_UNDERSTOOD = (400, 404, 422)
_REDIRECTS = (301, 302, 303, 307, 308)


@dataclass(slots=True)
class _Exchange:
    """A request: the most bytes of its answer, whether its connection had an earlier request, whether a byte came."""

    most: int
    reused: bool = False
    answered: bool = False


# This task's request.
_EXCHANGE: ContextVar[_Exchange] = ContextVar("exchange")
log = logging.getLogger(__name__)


class LLMClient:
    """Chat completions of one server. Time limits are the caller's: cancelling a call closes its connection.

    Args:
        base_url: up to and including ``/v1``.
        trust_env: obey ``HTTP_PROXY`` and similar variables.
        session_header: name of a header with each completion's session; None: none.
        extras: the operator's own fields, headers and query of each request.

    Raises:
        NoDecision: the environment names a proxy or certificates that cannot be used.
    """

    def __init__(
        self,
        base_url: str,
        *,
        api_key: str | None = None,
        trust_env: bool = True,
        session_header: str | None = None,
        extras: RequestExtras | None = None,
    ) -> None:
        self.base_url = base_url
        # Found once: aiohttp would look for a proxy at each call, in a thread.
        self._proxy = _proxy_to(base_url) if trust_env else {}
        self._session_header = session_header
        self._extras = extras or RequestExtras()
        self._terms = RequestTerms()
        # Parsed once: aiohttp would parse a string at each call.
        self._models, self._completions = (
            URL(f"{base_url}/{path}").update_query(self._extras.query) for path in ("models", "chat/completions")
        )
        # Identity: a compressed answer of a few kilobytes could unpack to gigabytes before its size is checked.
        headers = {"Accept-Encoding": "identity", "Content-Type": "application/json"}
        if api_key:
            headers["Authorization"] = f"Bearer {api_key}"
        headers |= self._extras.headers
        self._secrets = tuple(
            secret for secret in (api_key, *self._extras.headers.values(), *self._extras.query.values()) if secret
        )
        # The edge bounds its calls, so the connector need not; the certificates are those that httpx trusts.
        try:
            connector = _BoundedConnector(limit=0, ssl=httpx.create_ssl_context(trust_env=trust_env))
        except OSError as error:
            raise NoDecision("llm_error", f"SSL_CERT_FILE or SSL_CERT_DIR: {error}") from error
        self._http = aiohttp.ClientSession(
            headers=headers,
            connector=connector,
            timeout=aiohttp.ClientTimeout(total=None, sock_connect=None),
            cookie_jar=aiohttp.DummyCookieJar(),
            auto_decompress=False,
        )

    @property
    def terms(self) -> RequestTerms:
        """The changes of a request that the server has demanded."""
        return self._terms

    async def close(self) -> None:
        """Close every connection."""
        await self._http.close()

    async def models(self) -> list[str]:
        """The listed models' names, without unprintable ones and those of more than 200 characters.

        The list is OpenAI's, or without an object around it.

        Raises:
            NoDecision: the server gives no list, or no name in it can be used.
        """
        answer = await self._call("GET", self._models, None)
        try:
            models = answer if isinstance(answer, list) else answer["data"]
            listed = [model if isinstance(model, str) else model["id"] for model in models]
        except (KeyError, TypeError):
            said = excerpt_of(answer, self._secrets)
            detail = f"no list of models{f': {said}' if said else ''}"
            raise NoDecision("llm_error", f"{self.base_url}/models: {detail}") from None
        names = [n for n in listed if isinstance(n, str) and n.isprintable() and len(n) <= _MAX_NAME]
        if listed and not names:
            raise NoDecision("llm_error", f"{self.base_url}/models: no model has a name that can be used")
        return names

    async def complete(self, body: dict[str, Any], session: str | None = None) -> Completion:
        """The chat completion of a request body; raises :class:`NoDecision`.

        Args:
            session: an ID shared by completions with a common prefix, which a router may send to the same server.
        """
        terms = known = self._terms
        while True:
            sent = terms.applied(body)
            if self._extras.body:
                sent = {**sent, **self._extras.body}
            # Each token may come with the likeliest tokens of its position.
            tokens = sent[terms.max_tokens]
            most = max(_MAX_RESPONSE_BYTES, _BYTES_A_TOKEN * (tokens if isinstance(tokens, int) else 0))
            try:
                found = await self._call("POST", self._completions, sent, most, session)
                answer = completion_of(found, self.base_url, self._secrets)
            except NoDecision as refused:
                # Some servers refuse a field by 500, as a template that raises.
                by_status = refused.reason == "llm_status" and not isinstance(refused, Busy)
                other = terms.after_refusal(str(refused), sent) if by_status else None
                if other is None:
                    raise
            else:
                other = terms.with_more_tokens(self._extras.most_tokens) if answer.unfinished else None
                if other is None:
                    # An older call must not bring back what a later one has learned.
                    if terms is not known and not answer.unfinished:
                        self._remember(terms)
                    return answer
            terms = other

    def _remember(self, terms: RequestTerms) -> None:
        log.warning("%s: requests follow the server's refusals and limits from now on: %s", self.base_url, terms)
        self._terms = terms

    async def _call(
        self,
        method: str,
        url: URL,
        body: dict[str, Any] | None,
        most: int = _MAX_RESPONSE_BYTES,
        session: str | None = None,
    ) -> Any:
        sent = None if body is None else to_json(body)
        headers = {}
        if session is not None and self._session_header is not None:
            headers = {self._session_header: session}
        while True:
            exchange = _Exchange(most)
            try:
                status, head, content = await self._exchange(method, url, sent, headers, exchange)
                break
            except (aiohttp.ServerDisconnectedError, ConnectionResetError, aiohttp.ClientOSError) as error:
                # Any idle connection may have been closed as the request was sent (aiohttp 9138): nobody saw it.
                if not exchange.reused or exchange.answered or isinstance(error, aiohttp.ClientConnectorError):
                    raise self._failure(error) from error
            except (aiohttp.ClientError, OSError, ValueError) as error:
                raise self._failure(error) from error
        if not 200 <= status < 300:
            kind = NotUnderstood if status in _NOT_UNDERSTOOD else NoDecision
            target = head.get("Location", "").split("?")[0] if status in _REDIRECTS else ""
            said = excerpt(target.encode(errors="replace") or content, self._secrets)
            detail = f" to {said}" if target else f": {said}" if said else ""
            text = f"{self.base_url}: HTTP {status}{detail}"
            pause_s = pause_of(head)
            if pause_s is None or kind is NotUnderstood:
                raise kind("llm_status", text)
            raise Busy(f"{text} (no requests for {pause_s:.3g} s)", time.monotonic() + pause_s)
        for read in (json.loads, streamed):
            with suppress(ValueError, RecursionError):
                return read(content)
        raise NoDecision("llm_error", f"{self.base_url}: a 200 that is not JSON: {excerpt(content, self._secrets)!r}")

    async def _exchange(
        self, method: str, url: URL, sent: bytes | None, headers: dict[str, str], exchange: _Exchange
    ) -> tuple[int, Mapping[str, str], bytearray]:
        """Status, headers and body of the answer to one request."""
        content, options = bytearray(), self._proxy
        if headers:
            options = {**options, "headers": {**options.get("headers", {}), **headers}}
        present = _EXCHANGE.set(exchange)
        try:
            request = await self._http.request(method, url, data=sent, allow_redirects=False, **options)
        finally:
            _EXCHANGE.reset(present)
        async with request as response:
            if response.headers.get("Content-Encoding", "identity") != "identity":
                raise NoDecision("llm_error", f"{self.base_url}: compressed, though identity was asked for")
            async for chunk in response.content.iter_any():
                content += chunk
                if len(content) > exchange.most:
                    raise NoDecision("llm_error", f"{self.base_url}: more than {exchange.most} bytes")
        return response.status, response.headers, content

    def _failure(self, error: aiohttp.ClientError | OSError | ValueError) -> NoDecision:
        kind = Unreachable if isinstance(error, aiohttp.ClientConnectorError) else NoDecision
        return kind("llm_error", f"{self.base_url}: {connection_fault(error)}")


def client_of(settings: Settings) -> LLMClient:
    """The client of the one server that the settings name; raises :class:`NoDecision` as :class:`LLMClient` does."""
    if settings.llm_url is None:
        raise ValueError("the settings name no server")
    return LLMClient(
        settings.llm_url,
        api_key=settings.llm_api_key.get_secret_value() if settings.llm_api_key else None,
        session_header=settings.llm_session_header,
        extras=RequestExtras(
            settings.llm_extra_body, settings.llm_extra_headers, settings.llm_extra_query, settings.llm_thinking_tokens
        ),
    )


def _proxy_to(url: str) -> dict[str, Any]:
    """aiohttp's arguments for the proxy that the environment names for a URL; empty if it names none."""
    target = httpx.URL(url)
    proxies = getproxies()
    named = proxies.get(target.scheme) or proxies.get("all")
    if not named or proxy_bypass(target.host) or proxy_bypass(target.netloc.decode()):
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
    """Makes connections that are aborted past the bytes that an answer may have and 64 KB of heads."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        # aiohttp has no public argument for the class that reads a connection.
        kind: type[ResponseHandler] = _BoundedResponse
        self._factory = functools.partial(kind, loop=self._loop)


class _BoundedResponse(ResponseHandler):
    _exchange: _Exchange | None = None
    _left = 0

    def set_response_params(self, **params: Any) -> None:
        """Called by aiohttp as a request begins, in that request's task."""
        exchange = _EXCHANGE.get()
        exchange.reused = self._exchange is not None
        self._exchange = exchange
        self._left = exchange.most + _MAX_HEAD_BYTES
        super().set_response_params(**params)

    def data_received(self, data: bytes) -> None:
        self._left -= len(data)
        if self._exchange is not None:
            self._exchange.answered = True
        if self._left >= 0 or self.transport is None:
            super().data_received(data)
            return
        error = _TooMuch()
        self.set_exception(error)
        if self._payload is not None:
            self._payload.set_exception(error)
        # An idle connection is closed too: a server could send unrequested bytes without end.
        self.transport.abort()
