"""Examples for the OpenAPI document: of every request, every answer and every problem."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any

from shared.wire.problem import Problem
from shared.world.scenario import SCENARIOS

Example = dict[str, Any]

DECISION_ID = "0123456789abcdef0123456789abcdef"
SENSORS = {
    "id": [0, 1, 2, 3],
    "x": [420.0, 650.0, 300.0, 900.0],
    "y": [380.0, 520.0, 700.0, 100.0],
    "queue": [52.0, 17.0, 33.0, None],
    "battery": [49.0, 50.0, 47.5, None],
    "channel_gain": [-83.1, -96.0, -109.2, None],
    "last_seen": [0, 0, 0, None],
}
STATE = {"uav_id": 0, "position": [500.0, 450.0], "sensors": SENSORS}
OUTCOME = {"decision_id": DECISION_ID, "cost": 0.2, "failed": False}
NOTE = "Suspected leak at sensor 4: visit it every third step."
ORDERS = {
    "sensors": [{"sensor_id": 4, "weight": 1.0, "visit_every": 3}],
    "min_velocity": None,
    "max_velocity": 10,
    "forbidden_velocities": [],
}

DECISION = {
    "decision_id": DECISION_ID,
    "mission_id": "default",
    "uav_id": 0,
    "step": 0,
    "sensor_id": 0,
    "velocity": 5,
    "source": "guided",
    "reason": None,
    "model": "SmolLM2-135M-Instruct.Q8_0",
    "top_k": [{"sensor_id": 0, "score": -0.156479}, {"sensor_id": 2, "score": -0.304903}],
    "guided": {
        "trust": {"llm": 0.2, "planner": 0.6, "value": 0.1, "policy": 0.1},
        "calibrated": True,
        "candidates": [
            {"sensor_id": 0, "velocity": 5, "llm": 0.61, "mixture": 0.7431, "regret": 0.0, "score": -0.297},
            {"sensor_id": 2, "velocity": 6, "llm": 0.39, "mixture": 0.0064, "regret": 1.25, "score": -5.8059},
        ],
    },
    "tokens": {
        "tokenizer": "o200k_base",
        "static": 214,
        "experiences": 0,
        "state": 28,
        "state_uncompressed": 64,
        "prompt": 242,
        "uncompressed": 278,
        "saved": 36,
        "completion": 1,
        "cached": 0,
        "server_prompt": 290,
        "cost_usd": 0.0,
    },
    "deadline_ms": 3000,
    "latency_ms": {"plan": 160.7, "augment": 0.8, "attend": 0.5, "prompt": 0.4, "llm": 410.5, "total": 574.2},
    "stored": True,
}
GUIDANCE: dict[str, Any] = {
    "mission_id": "patrol",
    "status": "confirmed",
    "note": NOTE,
    "guidance": ORDERS,
    "in_words": "Visit sensor 4 at least once in every 3 steps. Never fly faster than 10 m/s.",
    "obeyed_in_words": "Visit sensor 4 at least once in every 3 steps. Never fly faster than 10 m/s.",
    "origin": "operator",
    "model": None,
    "failure": None,
    "doubts": [],
    "begins": [],
    "ends": [],
    "begun": ["Visit sensor 4 at least once in every 3 steps.", "Never fly faster than 10 m/s."],
    "ended": ["Visit sensor 2 at least once in every 5 steps."],
    "version": "5f0c2d9a1b7e4836",
}
MISSION = {
    "mission_id": "patrol",
    "scenario": SCENARIOS["paper"].model_dump(mode="json"),
    "mode": "guided",
    "top_k": 5,
    "attention": "on",
    "features": "reach",
    "belief": "fleet",
    "verify": "on",
    "planner": "on",
    "prompt": {"format": "csv", "order": "score", "experiences": 8, "selection": "recent", "demonstrations": 0},
    "init": "pretrained",
    "seed": 0,
    "note": NOTE,
    "decisions": 3,
    "feedback": 2,
    "experiences": 2,
    "learner_updates": 2,
    "learner_loss": 0.041,
    "visits": {"0": 0, "2": 1},
}
ATTENTION = {
    "mission_id": "patrol",
    "features": "paper",
    "belief": "reported",
    "top_k": 5,
    "updates": 2,
    "weights": [
        # Of a module with d' = 1: a real one has d' = 32.
        *(
            {"name": name, "shape": [1, 5], "values": [0.21, -0.08, 0.31, 0.02, -0.4]}
            for name in ("query", "key", "value")
        ),
        {"name": "score", "shape": [1, 1], "values": [-0.17]},
        {"name": "bias", "shape": [1], "values": [-0.25]},
    ],
}
_FIRST = {"mission_id": "default", "step": 0, **STATE}
# Sensor 1 was heard again, the others were not.
_CHANGED = {"id": [1], "queue": [21.0], "battery": [49.9], "channel_gain": [-95.2], "last_seen": [2]}
_BATCH = {"step": 0, "uavs": [STATE, {**STATE, "uav_id": 1, "position": [620.0, 480.0]}]}

# By method and path; what the paper's UAV would send comes first.
REQUESTS: dict[tuple[str, str], dict[str, Example]] = {
    ("post", "/decide"): {
        "paper": {"summary": "A UAV's first request: it says nothing of an outcome", "value": _FIRST},
        "outcome": {
            "summary": "A later request: what came of the decision before, and 1.5 s to answer",
            "value": {**_FIRST, "step": 1, "outcome": OUTCOME, "deadline_ms": 1500},
        },
        "held": {
            "summary": "A full report that the edge is to hold, so that the next may tell only what changed",
            "value": {**_FIRST, "step": 1, "uplink": "delta"},
        },
        "delta": {
            "summary": "The next: the sensors that are not as they were in the report that `base` answered",
            "value": {**_FIRST, "step": 2, "base": DECISION_ID, "sensors": _CHANGED},
        },
    },
    ("post", "/decide/batch"): {"fleet": {"summary": "Two UAVs at one step", "value": _BATCH}},
    ("post", "/feedback"): {
        "served": {"summary": "Packets came, few were lost", "value": {"mission_id": "default", **OUTCOME}},
    },
    ("put", "/missions/{mission_id}"): {
        "preset": {"summary": "A preset's world, and the operator's note", "value": {"mode": "guided", "note": NOTE}},
        "paper": {
            "summary": "The paper's method: mode llm, its random start, no rules",
            "value": {"scenario": "paper", "mode": "llm", "init": "random", "verify": "off", "planner": "off"},
        },
    },
    ("post", "/missions/{mission_id}/guidance"): {
        "own": {"summary": "The operator's own structure: obeyed at once", "value": {"guidance": ORDERS}},
        "confirm": {"summary": "What was understood is right", "value": {"answer": "confirm"}},
        "reject": {"summary": "It is not", "value": {"answer": "reject"}},
        "withdraw": {"summary": "End all orders in force", "value": {"answer": "withdraw"}},
        "note": {"summary": "A new note: read by the LLM, and obeyed once it is confirmed", "value": {"note": NOTE}},
    },
    ("post", "/missions/{mission_id}/readings"): {
        "uplink": {
            "summary": "A sensor's uplink of 12 s ago, and the message that brought it",
            "value": {
                "readings": [{"sensor_id": 3, "queue": 17.0, "battery": 41.5, "age_s": 12.0, "message_id": "a7-1834"}]
            },
        },
        "step": {
            "summary": "Two sensors' queues at the start of step 7",
            "value": {
                "readings": [
                    {"sensor_id": 3, "queue": 17.0, "step": 7},
                    {"sensor_id": 8, "queue": 0.0, "step": 7},
                ]
            },
        },
    },
}

# Of the answers that are no problem; 200 all of them.
ANSWERS: dict[tuple[str, str], Any] = {
    ("post", "/decide"): DECISION,
    ("post", "/decide/batch"): {
        "decisions": [
            DECISION,
            {**DECISION, "decision_id": DECISION_ID[::-1], "uav_id": 1, "sensor_id": 2, "velocity": 6},
        ]
    },
    ("post", "/feedback"): {"decision_id": DECISION_ID, "result": "applied"},
    ("put", "/missions/{mission_id}"): {
        **MISSION, "decisions": 0, "feedback": 0, "experiences": 0, "learner_updates": 0, "learner_loss": None,
        "visits": {},
    },
    ("get", "/missions/{mission_id}"): MISSION,
    ("get", "/missions/{mission_id}/attention"): ATTENTION,
    ("get", "/missions/{mission_id}/guidance"): GUIDANCE,
    ("post", "/missions/{mission_id}/guidance"): GUIDANCE,
    ("post", "/missions/{mission_id}/readings"): {"results": ["merged"], "step": 7},
    ("get", "/healthz"): {"status": "ok"},
    ("get", "/readyz"): {
        "ready": True,
        "decides": "guided",
        "llm": "ready",
        "model": "SmolLM2-135M-Instruct.Q8_0",
        "standing_by": 0,
        "constraint": "grammar",
        "detail": None,
    },
    ("get", "/missions"): {
        "missions": [
            {"mission_id": "patrol", "mode": "guided", "decisions": 3},
            {"mission_id": "asleep", "mode": None, "decisions": None},
        ],
        "more": 0,
        "newest": "patrol",
        "may_command": True,
    },
    ("get", "/missions/{mission_id}/decisions/{decision_id}/prompt"): {
        "decision_id": DECISION_ID,
        "asked": True,
        "static": "Each row is one sensor, the best first, with five numbers: ...",
        "experiences": "52,-90,2,140 > 3 7: 0.0\n",
        "state": "0,52,-83,0,106\n2,33,-109,0,320\n",
    },
}  # fmt: skip

# Status to the field at fault, if it is one's, and what is wrong with it.
PROBLEMS: dict[int, tuple[str | None, str]] = {
    400: ("body", "There was an error parsing the body"),
    401: (None, "send a known key as `Authorization: Bearer KEY`"),
    403: (None, "key fleet-1 lacks the scope admin"),
    404: ("mission_id", "there is no mission patrol"),
    408: ("body", "not received within 10 s"),
    409: ("mission_id", "mission patrol has another spec: DELETE it or choose another ID"),
    413: ("body", "larger than 2000000 bytes"),
    415: ("body", "Content-Encoding 'br': use gzip, zstd or none"),
    421: ("mission_id", "another edge has mission patrol: send the request there"),
    422: ("mission_id", "must match pattern '^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$'"),
    429: (None, "key fleet-1 has a limit of 600 requests a minute"),
    503: ("mission_id", "the store fails: nothing was recorded, send it again"),
}


def problem(status: int) -> Example:
    """A problem document of that status."""
    field, fault = PROBLEMS[status]
    whole = Problem(
        title=HTTPStatus(status).phrase,
        status=status,
        detail=f"{field}: {fault}" if field else fault,
        errors=[{"field": field, "problem": fault}] if field else [],
        owner="http://edge-2:8000" if status == HTTPStatus.MISDIRECTED_REQUEST else None,
    )
    return whole.model_dump(mode="json")
