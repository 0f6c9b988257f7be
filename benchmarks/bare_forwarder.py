"""A minimal Python service: a FastAPI application that forwards JSON with httpx and returns the answer.

python -m benchmarks.bare_forwarder 9010 http://127.0.0.1:9009/v1
"""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import httpx
import uvicorn
from fastapi import FastAPI, Request


def forwarder(upstream: str) -> FastAPI:
    """An application whose ``POST /decide`` forwards to ``POST chat/completions`` of the upstream."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[dict[str, httpx.AsyncClient]]:
        async with httpx.AsyncClient(base_url=upstream + "/", timeout=None) as client:
            yield {"client": client}

    app = FastAPI(lifespan=lifespan)

    @app.post("/decide")
    async def decide(request: Request) -> dict[str, Any]:
        answer = await request.state.client.post("chat/completions", json=await request.json())
        return dict(answer.json())

    @app.get("/healthz")
    async def healthz() -> dict[str, str]:
        return {"status": "ok"}

    return app


if __name__ == "__main__":
    uvicorn.run(forwarder(sys.argv[2]), host="127.0.0.1", port=int(sys.argv[1]), log_level="warning", access_log=False)
