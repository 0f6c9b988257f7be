"""A server's own words about a failure: a bounded excerpt without keys."""

import json
import math
import os
import re
import ssl
import time
from collections.abc import Mapping
from email.utils import parsedate_to_datetime
from typing import Any

import aiohttp

_MOST = 200
_READ = 8 * 1024
_SHORTEST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 480.0
_KEYS = re.compile(r"(bearer\s+|\b(?:sk|key|hf|gsk|nvapi|xai|pk)[-_])[^\s\"'<>]+|(?<=://)[^\s/@]+@", re.IGNORECASE)
_TAGS = re.compile(r"<(script|style).*?</\1>|<[^>]*>", re.IGNORECASE | re.DOTALL)


def excerpt(content: bytes | bytearray, secrets: tuple[str, ...] = ()) -> str:
    """The beginning of a failed answer's message, at most 200 characters: JSON's message, else the text without tags.

    Args:
        secrets: texts that must not appear, as the key that was sent.
    """
    text = bytes(content[:_READ]).decode(errors="replace")
    try:
        text = _message(json.loads(bytes(content))) or text
    except (ValueError, RecursionError):
        text = _TAGS.sub(" ", text)
    return _clean(text, secrets)


def excerpt_of(answer: Any, secrets: tuple[str, ...] = ()) -> str:
    """The same of a JSON answer's error object; empty if it is none."""
    return _clean(_message(answer), secrets)


def _clean(text: str, secrets: tuple[str, ...]) -> str:
    for secret in secrets:
        text = text.replace(secret, "***")
    text = " ".join(_KEYS.sub("***", text).split())
    return "".join(c if c.isprintable() else "?" for c in text[:_MOST])


def _message(answer: Any) -> str:
    """The message of OpenAI's, FastAPI's, Ollama's and Azure's error objects, with the parameter that it names."""
    if isinstance(answer, list):
        return _message(answer[0]) if answer else ""
    if isinstance(answer, str):
        return answer
    if not isinstance(answer, dict):
        return ""
    for key in ("error", "message", "detail", "msg", "title", "choices", "content_filter_results"):
        if found := _message(answer.get(key)):
            named = answer.get("param") or answer.get("loc")
            return f"{named}: {found}" if named and str(named) not in found else found
    return ""


def pause_of(headers: Mapping[str, str]) -> float | None:
    """Seconds of a refusal's ``Retry-After``, 0.1 to 480; None if there is none that can be read."""
    value = headers.get("Retry-After", "")
    try:
        seconds = float(value)
    except ValueError:
        try:
            seconds = parsedate_to_datetime(value).timestamp() - time.time()
        except (ValueError, OverflowError):
            return None
    return min(max(seconds, _SHORTEST_PAUSE_S), _LONGEST_PAUSE_S) if math.isfinite(seconds) else None


def connection_fault(error: aiohttp.ClientError | OSError | ValueError) -> str:
    """The reason why a connection failed; the error's own text is left out, as it may quote the request's headers."""
    if isinstance(error, aiohttp.ClientConnectorCertificateError):
        reason = error.certificate_error
        found = reason.verify_message if isinstance(reason, ssl.SSLCertVerificationError) else type(reason).__name__
        return f"the certificate is not trusted: {found}; SSL_CERT_FILE names further authorities"
    if isinstance(error, aiohttp.ClientHttpProxyError):
        return f"the proxy answers HTTP {error.status}"
    if isinstance(error, aiohttp.ClientConnectorError):
        inner = error.os_error
        system = os.strerror(inner.errno) if inner.errno is not None and inner.errno > 0 else inner.strerror
        found = getattr(inner, "reason", None) or system or type(inner).__name__
        proxy = "the proxy of the environment: " if isinstance(error, aiohttp.ClientProxyConnectionError) else ""
        return f"{proxy}{type(error).__name__}: {found}"
    return type(error).__name__
