"""The two ways to ask an edge for the decisions of a step: about one UAV after the other, or about all at once."""

from __future__ import annotations

from typing import Any

import httpx

PATHS = ("/decide", "/decide/batch")
# The fields that the UAVs of a batch share.
_SHARED = ("mission_id", "step", "deadline_ms")


def ask(client: httpx.Client, path: str, *reports: dict[str, Any], **headers: str) -> list[httpx.Response]:
    """The answers to the reports of one step, one for all where the path is a batch's."""
    bodies = list(reports)
    if path == "/decide/batch":
        uavs = [{key: value for key, value in body.items() if key not in _SHARED} for body in reports]
        bodies = [{**{key: reports[0][key] for key in _SHARED if key in reports[0]}, "uavs": uavs}]
    return [client.post(path, json=body, headers=headers) for body in bodies]


def decide(client: httpx.Client, path: str, *reports: dict[str, Any]) -> list[dict[str, Any]]:
    """The decisions about the reports of one step, in their order."""
    decisions: list[dict[str, Any]] = []
    for answer in ask(client, path, *reports):
        assert answer.status_code == 200, answer.text
        decisions += answer.json().get("decisions", [answer.json()])
    return decisions
