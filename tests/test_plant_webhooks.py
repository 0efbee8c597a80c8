"""Webhooks against an HTTP server: in order, again until taken, signed, and bounded while nobody answers."""

from __future__ import annotations

import hashlib
import hmac
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from barsight.core.errors import ConfigError, InputError
from barsight.plant.link_settings import WebhookSettings
from barsight.plant.webhooks import Webhook, post, read_secret
from opcua_servers import free_port
from plant_commands import Hooks


@pytest.fixture
def hooks() -> Iterator[Hooks]:
    one = Hooks()
    yield one
    one.close()


def until(test: Callable[[], bool]) -> None:
    end_s = time.monotonic() + 20
    while not test():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def test_changes_come_in_order_signed_and_again_until_taken(hooks: Hooks, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("sixteen bars\n")
    hooks.answers = [503, 429, 204, 422]  # the second change is dropped, the others are taken
    hook = Webhook(hooks.url, WebhookSettings((hooks.url,), tmp_path / "secret"))
    try:
        for number in range(3):
            hook.tell({"id": 7 + number, "event": "lift", "number": number})
        until(lambda: len(hooks.posts) == 5)
    finally:
        hook.stop()
    assert [(one["id"], one["number"]) for one in hooks.posts] == [(7, 0), (7, 0), (7, 0), (8, 1), (9, 2)]
    for one in hooks.posts:
        assert (
            one["signature"] == "sha256=" + hmac.new(b"sixteen bars", one["raw"], hashlib.sha256).hexdigest()
        )


def test_an_empty_secret_signs_nothing(hooks: Hooks, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("\n")
    with pytest.raises(InputError, match="its first line is empty"):
        read_secret(tmp_path / "secret")
    problem, is_final = post(hooks.url, WebhookSettings((hooks.url,), tmp_path / "secret"), {})
    assert problem is not None and not is_final and hooks.posts == []


def test_an_address_that_is_away_costs_bounded_memory(hooks: Hooks) -> None:
    port, url = free_port(), ""
    url = f"http://127.0.0.1:{port}/hook"
    hook = Webhook(url, WebhookSettings((url,), max_waiting=10))
    try:
        for number in range(1000):
            hook.tell({"event": "lift", "number": number})
        until(lambda: hook.problem is not None)
        assert hook.waiting == 10
        hook.url = hooks.url
        until(lambda: len(hooks.posts) == 10)
    finally:
        hook.stop()
    assert [one["number"] for one in hooks.posts] == list(range(990, 1000))
    assert [one["lost"] for one in hooks.posts] == [990] + 9 * [0]


def test_what_was_lost_is_told_until_a_post_is_taken(hooks: Hooks) -> None:
    """The first post after the outage, which tells it, is refused."""
    url = f"http://127.0.0.1:{free_port()}/hook"
    hook = Webhook(url, WebhookSettings((url,), max_waiting=3))
    try:
        for number in range(10):
            hook.tell({"event": "lift", "number": number})
        until(lambda: hook.problem is not None)
        hooks.answers = [422]
        hook.url = hooks.url
        until(lambda: len(hooks.posts) == 3)
    finally:
        hook.stop()
    assert [(one["number"], one["lost"]) for one in hooks.posts] == [(7, 7), (8, 7), (9, 0)]


def test_a_redirect_is_no_answer_and_an_address_is_http(hooks: Hooks) -> None:
    """A redirect may lead anywhere; the state goes to the configured address alone."""
    hooks.answers = [302]
    hook = Webhook(hooks.url, WebhookSettings((hooks.url,)))
    try:
        hook.tell({"event": "lift"})
        until(lambda: len(hooks.posts) == 2)
    finally:
        hook.stop()
    for url in ("file:///etc/passwd", "wms.example", "http://"):
        with pytest.raises(ConfigError, match="is not an address"):
            WebhookSettings((url,))
