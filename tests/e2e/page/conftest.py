"""A real browser, and pages that notice errors and requests to other hosts."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from urllib.parse import urlsplit

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, ConsoleMessage, Page, expect, sync_playwright

from service.api.app import create_app
from service.config.settings import Settings
from tests.support.processes import serving_edge
from tests.support.running import serving
from tests.support.waiting import PATIENCE_S

# As root, without a sandbox of its own, and without its calls home, which a closed network would refuse one by one.
_FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]

expect.set_options(timeout=PATIENCE_S * 1e3)

REFUSED = ("Failed to load resource",)
HOSTILE = '<img src=x onerror="window.hacked = 1"><script>window.hacked = 1</script>'

Start = Callable[..., tuple[str, subprocess.Popen[str]]]
Open = Callable[..., Page]
Report = Callable[..., dict[str, Any]]


@contextmanager
def edge_here() -> Iterator[str]:
    """An edge in this process, which decides by learned values."""
    with serving(create_app(Settings(mode="value", deadline_ms=60_000))) as url:
        yield url


@pytest.fixture(scope="module")
def edge() -> Iterator[str]:
    """One for the tests that need none of their own; each has missions of its own name there."""
    with edge_here() as url:
        yield url


def violations(page: Page) -> list[str]:
    found = Axe().run(page).response["violations"]
    return [f"{one['id']}: {one['help']}: {[node['target'] for node in one['nodes']][:3]}" for one in found]


@pytest.fixture(autouse=True, scope="module")
def made_missions(made_on_decide: None) -> None:
    """No test here is about missions that there are not."""


# Playwright runs an event loop in this thread as long as it lives: tests of other files could run none.
@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    found = shutil.which("chromium") or shutil.which("google-chrome")
    if found is None:
        pytest.fail("these tests look at the page in a browser: apt-get install --no-install-recommends chromium")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=found, args=_FLAGS)
        yield started
        started.close()


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts edges, as ``serving_edge`` does; they end after the pages that look at them."""
    with ExitStack() as stack:
        yield lambda **env: stack.enter_context(serving_edge(**env))


@pytest.fixture
def visit(browser: Browser, start: Start) -> Iterator[Open]:
    """Opens an edge's page; at the end there must have been no error but those expected, and no other host asked.

    ``expected`` are parts of console messages: a browser also tells there what the network refused.
    """
    errors: list[str] = []
    elsewhere: list[str] = []
    pages: list[Page] = []

    def opened(url: str, *, expected: tuple[str, ...] = (), **context: Any) -> Page:
        page = browser.new_context(**{"viewport": {"width": 1280, "height": 900}, **context}).new_page()
        pages.append(page)
        own = urlsplit(url).netloc

        def said(message: ConsoleMessage) -> None:
            if message.type in ("error", "warning") and not any(part in message.text for part in expected):
                errors.append(message.text)

        page.on("console", said)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("request", lambda r: elsewhere.append(r.url) if urlsplit(r.url).netloc not in (own, "") else None)
        page.goto(url)
        return page

    yield opened
    for page in pages:
        page.context.close()
    assert errors == []
    assert elsewhere == []
