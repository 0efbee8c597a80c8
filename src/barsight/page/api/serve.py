"""Run the page's server; before a port is opened, check that access to it is restricted."""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import logging
import socket
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from barsight.core.errors import ConfigError, InputError, OutputError
from barsight.core.extras import extra
from barsight.page.api.app import build_app
from barsight.page.live import LiveFolder
from barsight.page.watch import StoreWatch
from barsight.store.accounts import list_accounts
from barsight.store.opening import Store, open_store

with extra("page"):
    import uvicorn

_DRAIN_S = 1
USUAL_PORTS = {"http": ":80", "https": ":443"}


@dataclass(frozen=True)
class ServeOptions:
    """Addresses at which the page is reached.

    public_url: URL for browsers if it isn't this computer's loopback. certificate, key: PEM files for TLS.
    live: a live run's folder.
    """

    host: str = "127.0.0.1"
    port: int = 8000
    public_url: str | None = None
    certificate: Path | None = None
    key: Path | None = None
    live: Path | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ConfigError(f"port {self.port} does not exist; name a port from 1024 to 65535")
        if (self.certificate is None) != (self.key is None):
            raise ConfigError("--certificate and --key go together")
        for path in (self.certificate, self.key):
            if path is not None and not path.is_file():
                raise InputError(path, "no such file", "give a PEM file")
        if self.live is not None and self.live.exists() and not self.live.is_dir():
            raise InputError(self.live, "is a file", "name the folder that barsight live writes")
        if not self.is_loopback and self.public_url is None:
            raise ConfigError(
                f"--host {self.host} is reached from other computers: give its URL in browsers, --public-url "
                "https://NAME:PORT"
            )
        if self.public_url is not None and urlsplit(self.public_url).scheme != "https":
            raise ConfigError(
                f"--public-url {self.public_url} is not https: give --certificate and --key, or a proxy"
            )
        if not self.is_loopback and self.certificate is None:
            raise ConfigError(
                f"--host {self.host} would send passwords unencrypted: give --certificate and --key, or "
                "leave --host out and let a proxy on this computer encrypt"
            )

    @property
    def is_loopback(self) -> bool:
        """Check that the address can only be reached from this computer."""
        try:
            return self.host == "localhost" or ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    def names(self, port: int) -> tuple[frozenset[str], frozenset[str]]:
        """List the hosts and origins that requests may name; browsers leave out a usual port."""
        scheme = "https" if self.certificate else "http"
        served = [(scheme, f"{name}:{port}") for name in ("127.0.0.1", "localhost", "[::1]")]
        if self.public_url is not None:
            served.append(("https", urlsplit(self.public_url).netloc.lower()))
        served += [(one, host.removesuffix(USUAL_PORTS[one])) for one, host in served]
        return frozenset(host for _, host in served), frozenset(f"{one}://{host}" for one, host in served)


def serve(url: str, options: ServeOptions) -> None:
    """Serve a store's page until Ctrl-C and print its address. Raises ConfigError if it were unprotected."""
    with serving(url, options) as address:
        print(f"{address} (Ctrl-C ends it)", flush=True)
        if options.live is not None and not options.live.exists():
            print(f"{options.live}: not there yet; the page shows the live run once it is", file=sys.stderr)
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()


@contextlib.contextmanager
def serving(url: str, options: ServeOptions) -> Iterator[str]:
    """Serve while the context is open; yield the address."""
    with open_store(url) as store:
        _expect_accounts(store, options)
        with contextlib.closing(_bind(options)) as listener:
            port = int(listener.getsockname()[1])
            watch = StoreWatch(store, None if options.live is None else LiveFolder(options.live))
            hosts, origins = options.names(port)
            is_secure = options.certificate is not None or options.public_url is not None
            app = build_app(watch, hosts, origins, is_secure=is_secure)
            logging.getLogger("uvicorn.error").addFilter(_is_no_cancelled_stream)
            server = uvicorn.Server(
                uvicorn.Config(
                    app, log_level="warning", access_log=False, server_header=False, lifespan="on",
                    ssl_certfile=options.certificate, ssl_keyfile=options.key, proxy_headers=False,
                    timeout_graceful_shutdown=_DRAIN_S, limit_concurrency=500,
                )
            )  # fmt: skip
            thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, name="page server")
            thread.start()
            try:
                while not server.started:
                    if not thread.is_alive():
                        raise OutputError("the server did not start; the lines above say why")
                    time.sleep(0.01)
                yield f"{'https' if options.certificate else 'http'}://{_shown(options.host)}:{port}"
            finally:
                server.should_exit = True
                thread.join()


def _is_no_cancelled_stream(record: logging.LogRecord) -> bool:
    """Suppress the message that event streams were still open when the server ended: they always are."""
    return "timeout graceful shutdown exceeded" not in record.getMessage() and "CancelledError" not in str(
        record.exc_info
    )


def _shown(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _expect_accounts(store: Store, options: ServeOptions) -> None:
    with store.reading() as connection:
        accounts = list_accounts(connection)
    is_open = options.is_loopback and options.public_url is None
    if not is_open and not accounts:
        raise ConfigError(
            "the store has no accounts, and others would reach the page; add an engineer: barsight store "
            f"user {store.name} NAME --role engineer"
        )


def _bind(options: ServeOptions) -> socket.socket:
    family = socket.AF_INET6 if ":" in options.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((options.host, options.port))
    except OSError as error:
        listener.close()
        reason = "is taken" if error.errno == errno.EADDRINUSE else "may not be used"
        raise OutputError(f"port {options.port} of {options.host} {reason}; name another port") from error
    return listener
