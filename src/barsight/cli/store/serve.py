"""Run `barsight serve --store URL`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from barsight.cli.arguments import call
from barsight.core.extras import extra
from barsight.store.opening import DEFAULT_URL


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and serve until Ctrl-C."""

    def command(
        store: str = DEFAULT_URL, host: str = "127.0.0.1", port: int = 8000, public_url: str | None = None,
        certificate: Path | None = None, key: Path | None = None, live: Path | None = None,
    ) -> None:  # fmt: skip
        """Serve the operator's page and its API for a store until Ctrl-C; works offline.

        On this computer's loopback address, nobody needs an account until `barsight store user` has added
        one. Access from other computers requires accounts and TLS.

        Args:
            store: SQLAlchemy URL of the database.
            host: Address to serve at.
            port: Port to serve at; 0 takes a free one.
            public_url: URL of the page for browsers on other computers, like https://yard.example:8000.
            certificate: PEM file of the server's certificate, for TLS.
            key: PEM file of the certificate's key.
            live: Folder that a live run writes, whose health is shown.
        """
        with extra("page"):
            from barsight.page.api.serve import ServeOptions, serve
        serve(store, ServeOptions(host, port, public_url, certificate, key, live))

    call(command, "serve", arguments)
