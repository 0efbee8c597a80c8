"""Run `barsight serve --store URL`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from barsight.cli.arguments import call
from barsight.core.extras import extra
from barsight.store.opening import DEFAULT_URL


def run(arguments: Sequence[str]) -> None:
    """Parse and serve until Ctrl-C."""

    def command(
        store: str = DEFAULT_URL, host: str = "127.0.0.1", port: int = 8000, public_url: str | None = None,
        certificate: Path | None = None, key: Path | None = None, live: Path | None = None,
    ) -> None:  # fmt: skip
        """Serve the operator's page and its API on a store; works offline, Ctrl-C ends it.

        On this computer's loopback nobody needs an account until `barsight store user` has added one. To be
        reached from other computers it needs accounts and TLS.

        Args:
            store: SQLAlchemy's URL of the database.
            host: Address to serve at.
            port: Port to serve at; 0 takes a free one.
            public_url: What browsers of other computers call it, like https://yard.example:8000.
            certificate: PEM file of the server's certificate, for TLS.
            key: PEM file of its key.
            live: Folder that a live run writes, for its health.
        """
        with extra("page"):
            from barsight.page.api.serve import ServeOptions, serve
        serve(store, ServeOptions(host, port, public_url, certificate, key, live))

    call(command, "serve", arguments)
