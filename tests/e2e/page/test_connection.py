"""The page loses its edge, and asks for a key where the edge does."""

from __future__ import annotations

import signal
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import expect

from tests.e2e.page.conftest import Open, Report, Start, violations
from tests.support.processes import output_until, run, started
from tests.support.waiting import PATIENCE_S

pytestmark = [pytest.mark.needs("chromium"), pytest.mark.long]

REFUSED = ("Failed to load resource",)
GONE = (*REFUSED, "net::ERR_")


def test_a_lost_connection_is_told_and_taken_up_again(visit: Open, start: Start, report: Report) -> None:
    url, process = start(AICVDS_MODE="value")
    httpx.post(f"{url}/decide", json=report(), timeout=PATIENCE_S)
    page = visit(url, expected=GONE)
    expect(page.locator("#connection")).to_have_text("Connected")
    process.send_signal(signal.SIGTERM)
    process.wait(PATIENCE_S)
    expect(page.locator("#connection")).to_have_text("Connection lost, trying again")
    expect(page.locator("#trouble")).to_contain_text("The edge does not answer")
    port = url.rsplit(":", 1)[1]
    with started("serve", "--port", port, AICVDS_MODE="value") as again:
        output_until(again, "startup complete")
        httpx.post(f"{url}/decide", json=report(step=7), timeout=PATIENCE_S)
        expect(page.locator("#connection")).to_have_text("Connected")
        expect(page.locator("#trouble")).to_be_hidden()
        expect(page.locator("#feed li")).to_have_count(1)
        expect(page.locator("#feed li")).to_contain_text("step 7")


def test_the_page_asks_for_a_key_where_the_edge_does(visit: Open, start: Start, report: Report, tmp_path: Path) -> None:
    keys = str(tmp_path / "keys.json")
    key = run("keys", "add", "fleet", "--file", keys, "--scopes", "decide", "admin").stdout.strip()
    reader = run("keys", "add", "reader", "--file", keys, "--scopes", "decide").stdout.strip()
    url, _ = start(AICVDS_MODE="value", AICVDS_KEYS=keys)
    httpx.post(f"{url}/decide", json=report(), timeout=PATIENCE_S, headers={"Authorization": f"Bearer {key}"})
    page = visit(url, expected=REFUSED)
    asked = page.get_by_role("dialog", name="This edge asks for a key")
    expect(asked).to_be_visible()
    assert violations(page) == []
    asked.get_by_label("Key", exact=True).fill("wrong")
    page.keyboard.press("Enter")
    expect(asked).to_be_hidden()
    expect(asked).to_be_visible()
    expect(asked).to_contain_text("The key that was given is not known here")
    asked.get_by_label("Key", exact=True).fill(reader)
    page.keyboard.press("Enter")
    expect(page.locator("#feed li")).to_have_count(1)
    assert page.evaluate("[localStorage.length, document.cookie]") == [0, ""]
    assert reader not in page.url
    # It counts no more: the stream ends, and the page asks again.
    run("keys", "remove", "reader", "--file", keys)
    expect(asked).to_be_visible()
