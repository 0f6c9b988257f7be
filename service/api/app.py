"""The application: wiring, lifespan and middleware. Importing this module has no side effects."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version
from typing import TypedDict

from fastapi import FastAPI

from service.api import live_routes, problem_details
from service.api.api_keys import ApiKeys
from service.api.authentication import KeyAuthentication, KnownHosts
from service.api.openapi import schema_of
from service.api.request_limits import RequestLimits
from service.api.routes import decisions, router
from service.config.settings import Settings
from service.edge.compilation import load_for_event_loop
from service.edge.engine import Engine
from service.llm.server_pool import ServerPool
from service.mission.prompt_fit import warm_up
from service.observability.metrics import Metrics
from service.observability.tracing import Traced, Traces, provider_from_environment
from service.prompting.token_accounting import TokenCounter
from service.server.middleware import SecurityHeaders
from service.storage.store import Store


class RequestState(TypedDict):
    """The content of ``request.state``."""

    engine: Engine
    llm: ServerPool
    metrics: Metrics
    keys: ApiKeys | None


def create_app(settings: Settings, store: Store | None = None) -> FastAPI:
    """One edge service; its LLM begins to load when the application starts.

    Args:
        store: the missions' durable store, closed when the application ends; None keeps missions in memory only.

    Raises:
        BadKeys: the file of keys that the settings name cannot be used.
    """

    keys = None if settings.keys is None else ApiKeys(settings.keys)
    traces = Traces(provider_from_environment(version("aic-vds")), settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[RequestState]:
        metrics = Metrics()
        llm = ServerPool(settings, warm_up(settings), metrics.llm_breaker_opened.inc)
        vocabulary = asyncio.to_thread(TokenCounter, settings.cache_dir)
        counter, _ = await asyncio.gather(vocabulary, asyncio.to_thread(load_for_event_loop))
        engine = Engine(settings, llm, counter, metrics, traces, store)
        app.state.engine = engine
        llm.start()
        try:
            yield {"engine": engine, "llm": llm, "metrics": metrics, "keys": keys}
        finally:
            may_close = await engine.close()
            await llm.close()
            if may_close and store is not None:
                store.close()
            await asyncio.to_thread(traces.close)

    app = FastAPI(
        title="AIC-VDS edge",
        version=version("aic-vds"),
        summary="Which sensor to collect from, and how fast to fly",
        lifespan=lifespan,
        # Their scripts come from a public host, and a redirect would repeat any Host.
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        # The edge's own traces have a span for each decision; FastAPI would look for a provider at each request.
        telemetry={"tracing": False, "metrics": False, "logs": False},
    )
    # include_router would build each route once more, on the first request.
    app.router.routes += [*decisions.routes, *router.routes, *live_routes.router.routes]
    app.mount("/static", live_routes.compressed(live_routes.ASSETS), name="static")
    app.add_middleware(RequestLimits, most=settings.max_requests, limit=settings.max_body_bytes)
    if keys is not None:
        app.add_middleware(KeyAuthentication, keys=keys)
    app.add_middleware(KnownHosts, settings=settings)
    app.add_middleware(SecurityHeaders)
    if traces.provider is not None:
        app.add_middleware(Traced)
    problem_details.install(app)
    app.openapi = lambda: schema_of(app)  # type: ignore[method-assign]
    return app
