"""Reads a chat completion as servers really send it; the decision's own checks are in :mod:`service.llm.answers`.

Servers that were seen: a model's thoughts before the answer, within ``<think>`` tags (QwQ behind vLLM without a
reasoning parser) or in a field of their own with no content yet (Ollama, vLLM 39103); content as a list of parts
(Mistral, LiteLLM); a JSON answer within a Markdown fence (vllm 38696); the byte-level tokens of GPT-2's vocabulary,
whose blank is written as another letter (lmdeploy 2802), and null among the token probabilities; gpt-oss's channels
(mlx-lm 1867), special tokens after the answer (llama.cpp 6924), an answer where its thoughts belong (rig 1656) or in a
tool call (litellm 6741), and event streams that nobody asked for (unsloth 6570).
"""

import json
import math
import os
import re
import ssl
from collections.abc import Mapping
from typing import Any

import aiohttp

from service.llm.answers import Completion, NoDecision, TokenPosition
from shared.kit.retry_after import asked_pause_s

_MOST = 200
_READ = 2 * 1024
_SHORTEST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 480.0
_KEYS = re.compile(r"(bearer\s+|\b(?:sk|key|hf|gsk|nvapi|xai|pk)[-_])[^\s\"'<>]+|(?<=://)[^\s/@]+@", re.IGNORECASE)
_TAGS = re.compile(r"<(script|style).*?</\1>|<[^>]*>", re.IGNORECASE | re.DOTALL)
_MAX_TOKENS, _MAX_POSITIONS, _MAX_LIKELIEST = 10**9, 4096, 80
_TAG = r"(?:(?:seed:)?think(?:ing)?|thoughts?|reasoning|analysis|scratch_?pad)[>\]]"
_THOUGHTS = re.compile(rf"\A\s*(?:[<\[]{_TAG}.*?[<\[]/{_TAG}\s*)+", re.DOTALL | re.IGNORECASE)
_UNCLOSED = re.compile(rf"\A\s*[<\[]{_TAG}", re.IGNORECASE)
_CLOSING = re.compile(rf"[<\[]/{_TAG}", re.IGNORECASE)
# Thoughts between special tokens (Cohere, Open Thoughts).
_MARKED = re.compile(r"<\|(start|begin|end)_(?:of_)?th(?:inking|ought)\|>", re.IGNORECASE)
_FINAL = re.compile(r".*<\|channel\|>final[^<]*<\|message\|>", re.DOTALL)
_SPECIAL = re.compile(r"(?:<[|\uff5c][^<>]{1,40}[|\uff5c]>|</s>|<end_of_turn>|<eos>|<pad>)\Z")
# An answer that has none of these.
_PLAIN = re.compile(r"[a-zA-Z0-9 .,:;+-]*")
_LONGEST_SPECIAL, _FENCE = 44, "```"
_WRAPPED = re.compile(
    r"""\A\s*(?:\*\*(.*)\*\*|\*(.*)\*|"(.*)"|`(.*)`|\\boxed\{(.*)\}|<answer>(.*)</answer>|<\|[^<>]{1,40}\|>(.*))\s*\Z""",
    re.DOTALL,
)
# The beginning of an answer that was cut: of thoughts that the prompt opens (DeepSeek-R1, QwQ), or of JSON. A small
# model that rambles, or adds blanks to its JSON without end, would go on.
_BEGUN = re.compile(r"(?i)\s*(?:(?:okay|alright|hmm+|first|let'?s|let me|we need|i need)\b|\{\s*\"[^}]*(?<!\s{8})\Z)")
# A fenced block's language.
_LANGUAGE = re.compile(r"\A[a-zA-Z]+(?=\s*\n\s*\S|\s*[{\[\d])")
# Kimi-VL writes its tags with triangles.
_ODD_CHARACTERS = str.maketrans({"\ufeff": None, "\u200b": None, "\u00a0": " ", "◁": "<", "▷": ">"})
# A blank and the end of a line in the vocabularies of GPT-2 and SentencePiece.
_BLANKS = str.maketrans({"Ġ": " ", "▁": " ", "Ċ": "\n"})


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
    seconds = asked_pause_s(headers)
    return None if seconds is None else min(max(seconds, _SHORTEST_PAUSE_S), _LONGEST_PAUSE_S)


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


def completion_of(answer: Any, base_url: str, secrets: tuple[str, ...] = ()) -> Completion:
    """The completion of a server's JSON answer.

    Args:
        secrets: texts that no error may quote, as the key that was sent.

    Raises:
        NoDecision: the answer is an error object, or has no text, not even an empty one.
    """
    try:
        choice = answer["choices"][0]
        message = choice.get("message") or choice.get("delta") or {"content": choice["text"]}
        content, reasoning = message.get("content"), message.get("reasoning_content") or message.get("reasoning")
        failed = choice.get("error") or message.get("refusal")
    except (AttributeError, KeyError, IndexError, TypeError):
        said = excerpt_of(answer, secrets)
        detail = f"a 200 that is no chat completion{f': {said!r}' if said else ''}"
        raise NoDecision("llm_error", f"{base_url}: {detail}") from None
    cut = choice.get("finish_reason") == "length"
    text = _text(content)
    if not text and not failed and not cut:
        text = (
            _arguments(message.get("tool_calls") or [{"function": message.get("function_call")}])
            or _text(reasoning)
            or text
        )
    if text is None and (reasoning or cut):
        text = ""
    if text is None or (failed and not text):
        said = excerpt_of(failed, secrets)
        raise NoDecision("llm_error", f"{base_url}: a completion without text{f': {said!r}' if said else ''}")
    plain = _without_thoughts(text)
    positions = _positions(choice)
    if reasoning or not (plain == text or (plain and text.startswith(plain))):
        # vLLM's logprobs have the thoughts' tokens too, where it gives the thoughts apart.
        positions = _after_thoughts(positions) or (positions if plain == text else ())
    prompt, cached, completion = _counts(answer.get("usage"))
    unfinished = cut and (_BEGUN.match(plain) if plain.strip() else not text or reasoning or plain != text)
    return Completion(plain, prompt, cached, completion, positions, unfinished=bool(unfinished))


def _text(content: Any) -> str | None:
    if isinstance(content, list):
        known = [part if isinstance(part, dict) else {"text": part} for part in content]
        parts = [part.get("text") for part in known if part.get("type", "text") in ("text", "output_text")]
        return "".join(part for part in parts if isinstance(part, str))
    if isinstance(content, dict):
        return json.dumps(content)
    return content if isinstance(content, str) else None


def _arguments(calls: Any) -> str | None:
    """The arguments of the only tool call; None if there is none."""
    try:
        (call,) = calls
        return _text(call["function"]["arguments"])
    except (KeyError, TypeError, ValueError):
        return None


def streamed(content: bytes | bytearray) -> Any:
    """The completion whose parts, or whose whole, a server sent as events; raises ``ValueError``."""
    lines = content.decode(errors="replace").split("\n")
    data = [line.removeprefix("data:") for line in lines if line.startswith(("data:", "{"))]
    parts = [json.loads(line) for line in data if line.strip() != "[DONE]"]
    try:
        found = [part["choices"][0] for part in parts if part.get("choices")]
        messages = [one.get("delta") or one.get("message") or {} for one in found]
        joined = {
            key: "".join(message.get(key) or "" for message in messages)
            for key in ("content", "reasoning_content", "reasoning")
        }
        positions = [position for one in found for position in (one.get("logprobs") or {}).get("content") or []]
        ends = [one["finish_reason"] for one in found if one.get("finish_reason")]
        usage = [part["usage"] for part in parts if part.get("usage")]
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(str(error)) from None
    if not found:
        # A failure is an event, too.
        return parts[-1] if parts else json.loads(b"")
    choice = {"message": joined, "finish_reason": ends[-1] if ends else None, "logprobs": {"content": positions}}
    return {"choices": [choice], "usage": usage[-1] if usage else None}


def _without_thoughts(text: str) -> str:
    """A text without thoughts, special tokens and marks around its answer; empty if the thoughts have no end."""
    if _PLAIN.fullmatch(text):
        return text
    text = _without_specials(text.translate(_ODD_CHARACTERS))
    text = _MARKED.sub(lambda mark: "</think>" if mark[1].lower() == "end" else "<think>", text)
    if "<|message|>" in text:
        final = _FINAL.match(text)
        text = text[final.end() :] if final else ""
    if _UNCLOSED.match(text) or _CLOSING.search(text):
        text = _THOUGHTS.sub("", text)
        # Some chat templates open the thoughts in the prompt, so that the answer has the closing tag alone.
        text = "" if _UNCLOSED.match(text) else _CLOSING.split(text)[-1].lstrip()
    text = _without_fence(text)
    wrapped = _WRAPPED.match(text)
    return wrapped[wrapped.lastindex or 0] if wrapped else text


def _without_fence(text: str) -> str:
    """The content of a text that is one fenced block; else the text. In linear time, for any number of newlines."""
    block = text.strip()
    if len(block) < 2 * len(_FENCE) or not (block.startswith(_FENCE) and block.endswith(_FENCE)):
        return text
    return _LANGUAGE.sub("", block[len(_FENCE) : -len(_FENCE)]).strip()


def _without_specials(text: str) -> str:
    """A text without the special tokens at its end and the blanks around them, in time linear in its length."""
    end = whole = len(text.rstrip())
    while end and (special := _SPECIAL.search(text, max(0, end - _LONGEST_SPECIAL), end)):
        end = special.start()
        while end and text[end - 1].isspace():
            end -= 1
    return text[:end] if end < whole else text


def _counts(usage: Any) -> tuple[int | None, int | None, int | None]:
    """Tokens of the prompt, of its cached part and of the completion, where the server gives plausible ones."""
    usage = usage if isinstance(usage, dict) else {}
    details = usage.get("prompt_tokens_details")
    cached = details.get("cached_tokens") if isinstance(details, dict) else None
    counts = (usage.get("prompt_tokens"), cached, usage.get("completion_tokens"))
    prompt, cached, completion = (c if type(c) is int and 0 <= c <= _MAX_TOKENS else None for c in counts)
    return prompt, cached if prompt is None or cached is None else min(cached, prompt), completion


def _positions(choice: Any) -> tuple[TokenPosition, ...]:
    """The readable positions of an answer: OpenAI's ``top_logprobs``, or llama.cpp's ``top_probs``."""
    found: list[TokenPosition] = []
    try:
        for position in choice["logprobs"]["content"][:_MAX_POSITIONS]:
            likeliest = _probabilities(position.get("top_logprobs") or position.get("top_probs") or [])
            token = str(position.get("token", "")).translate(_BLANKS)
            found.append(TokenPosition(token, likeliest, "top_probs" in position))
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError):
        pass
    return tuple(found) if any(position.likeliest for position in found) else ()


def _after_thoughts(positions: tuple[TokenPosition, ...]) -> tuple[TokenPosition, ...]:
    """The positions after the thoughts' closing tag and its blanks; none if no token has the tag."""
    closed = [index for index, position in enumerate(positions) if _CLOSING.search(position.token)]
    if not closed:
        return ()
    rest = positions[closed[-1] + 1 :]
    return rest[next((index for index, position in enumerate(rest) if position.token.strip()), len(rest)) :]


def _probabilities(likeliest: Any) -> dict[str, float]:
    found: dict[str, float] = {}
    for entry in [each for each in likeliest[:_MAX_LIKELIEST] if isinstance(each, dict)]:
        probability = entry["prob"] if "prob" in entry else math.exp(min(0.0, entry["logprob"]))
        # A NaN, in either field, is no probability.
        known = 0.0 <= probability <= 1.0 and not math.isnan(entry.get("logprob", 0.0))
        if isinstance(entry["token"], str) and known:
            token = entry["token"].translate(_BLANKS).strip()
            found[token] = min(1.0, found.get(token, 0.0) + float(probability))
    return found
