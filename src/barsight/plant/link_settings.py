"""Settings of the OPC UA, MQTT, S7 and webhook links: the tables of plant.toml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from barsight.core.errors import ConfigError
from barsight.core.settings.values import expect_choice, expect_ranges, expect_values

MAX_AGE_S = 0.3
"""Maximum age of a state in seconds, counted from when it was read from the store; an older one is marked
invalid. A link shows a state for as long again at most.
"""
OPCUA_ROLES = ("viewer", "operator", "engineer")
"""Roles: a viewer reads; an operator also runs jobs, takes lifts and acknowledges alarms; an engineer also
handles recipes.
"""


@dataclass(frozen=True)
class OpcUaSettings:
    """The OPC UA server, from the table `[opcua]` of plant.toml."""

    host: str = "127.0.0.1"
    """Address on which the server listens; 0.0.0.0 for all networks of the computer."""
    port: int = 4840
    """TCP port on which the server listens."""
    folder: Path = Path("opcua")
    """Folder with the server's certificate and key, `trusted/` for client certificates, and `revoked/` for
    CRLs.
    """
    users: Path | None = None
    """users.json, written by `add_user` of barsight.plant.opcua.security.access. Without it every client is
    at most a viewer.
    """
    nodesets: Path | None = None
    """Folder with Opc.Ua.MachineVision.NodeSet2.xml (npm's node-opcua-nodesets). None: plain variables
    only.
    """
    allow_anonymous: bool = True
    """Allow anyone with a trusted certificate to read without logging in."""
    allow_unsecured: bool = False
    """Allow clients to connect without certificate and encryption. For a test bench only."""
    max_clients: int = 50
    """Maximum number of client connections at a time."""
    max_subscriptions: int = 100
    """Maximum number of subscriptions of all clients together, including those of closed sessions."""
    max_queue: int = 100
    """Maximum number of values or events queued for each monitored item of a client; the oldest are
    dropped.
    """
    max_unacknowledged: int = 20
    """Maximum number of notifications that a subscription keeps for a client that doesn't acknowledge
    them.
    """
    max_subscription_cycles: int = 600
    """Number of publishing cycles after which a subscription without publish requests is dropped."""
    state_every_s: float = 0.1
    """Interval in seconds at which the server reads the plant state, at most 0.3."""
    kept_results: int = 20
    """Number of survey results that clients can request; older ones are dropped."""

    def __post_init__(self) -> None:
        expect_values(self, "opcua.")
        expect_ranges(
            self, "opcua.", port=(1, 65535), max_clients=(1, 1000), max_subscriptions=(1, 10000),
            max_queue=(1, 10000), max_unacknowledged=(1, 1000), max_subscription_cycles=(10, 15000),
            state_every_s=(0.01, MAX_AGE_S), kept_results=(1, 1000),
        )  # fmt: skip

    @property
    def url(self) -> str:
        """Return the URL of the endpoint."""
        return f"opc.tcp://{self.host}:{self.port}/barsight"

    @property
    def nodeset(self) -> Path | None:
        """Find the NodeSet file. Raises ConfigError if the configured folder doesn't contain it."""
        if self.nodesets is None:
            return None
        path = self.nodesets / "Opc.Ua.MachineVision.NodeSet2.xml"
        if not path.is_file():
            raise ConfigError(f"{path}: no such file; {NODESET_REMEDY}")
        return path


NODESET_REMEDY = "run: npm install node-opcua-nodesets, and set opcua.nodesets to its folder `nodesets`"


@dataclass(frozen=True)
class MqttSettings:
    """The MQTT publisher, from the table `[mqtt]` of plant.toml."""

    host: str = "127.0.0.1"
    """Host name or address of the broker."""
    port: int = 1883
    """TCP port of the broker; usually 8883 with TLS."""
    version: str = "5"
    """Version of MQTT: `5`, by which a state that isn't renewed ends after a second, or `3.1.1`, by which the
    last will alone ends it.
    """
    prefix: str = "barsight/crane"
    """Prefix of all topics."""
    user: str | None = None
    """User name for the broker."""
    password_file: Path | None = None
    """File whose first line is the password for the broker."""
    authority: Path | None = None
    """Certificate of the broker's certificate authority (PEM file). If it is set, the connection is
    encrypted.
    """
    keepalive_s: int = 5
    """Keep-alive interval in seconds; the broker publishes the last will after 1.5 times this long without a
    message.
    """
    max_waiting: int = 100
    """Maximum number of events kept while the broker is unreachable."""
    max_retry_s: float = 10.0
    """Longest wait in seconds between attempts to reach the broker; the first wait is 0.1 s."""
    state_every_s: float = 0.1
    """Shortest interval in seconds between published states, at most 0.3."""

    def __post_init__(self) -> None:
        expect_values(self, "mqtt.")
        expect_ranges(
            self, "mqtt.", port=(1, 65535), keepalive_s=(1, 3600), max_waiting=(1, 100000),
            max_retry_s=(0.1, 600), state_every_s=(0.01, MAX_AGE_S),
        )  # fmt: skip
        expect_choice("mqtt.version", self.version, ("5", "3.1.1"))
        if not self.prefix or set("#+\0") & set(self.prefix) or self.prefix.startswith("$"):
            raise ConfigError(
                f"mqtt.prefix: {self.prefix!r} is not a topic; leave out #, + and a $ at the front"
            )


@dataclass(frozen=True)
class S7Settings:
    """The S7 client, from the table `[s7]` of plant.toml."""

    host: str = "127.0.0.1"
    """Host name or address of the PLC."""
    port: int = 102
    """TCP port of the PLC."""
    rack: int = 0
    """Rack number of the CPU."""
    slot: int = 1
    """Slot number of the CPU: 1 for S7-1200 and S7-1500, 2 for S7-300."""
    read_db: int = 100
    """Number of the data block that the PLC writes: encoders, hoist, magnet, clock, life counter."""
    read_start: int = 0
    """Offset in bytes of the telegram in `read_db`."""
    write_db: int = 101
    """Number of the data block that Barsight writes."""
    write_start: int = 0
    """Offset in bytes of the telegram in `write_db`."""
    cycle_s: float = 0.1
    """Interval in seconds between exchanges."""
    silent_s: float = 0.3
    """Timeout in seconds: if the PLC's life counter stands still for longer, the state is sent as invalid."""
    max_retry_s: float = 5.0
    """Longest wait in seconds between attempts to reach the PLC."""

    def __post_init__(self) -> None:
        expect_values(self, "s7.")
        expect_ranges(
            self, "s7.", port=(1, 65535), rack=(0, 7), slot=(0, 31), read_db=(1, 65535),
            read_start=(0, 65535), write_db=(1, 65535), write_start=(0, 65535), cycle_s=(0.01, 10),
            silent_s=(0.02, 60), max_retry_s=(0.1, 600),
        )  # fmt: skip


@dataclass(frozen=True)
class WebhookSettings:
    """Webhooks for the yard management system: each change of the state is posted as JSON."""

    urls: tuple[str, ...] = ()
    """Addresses to post to, http or https; each gets all changes, in order."""
    secret_file: Path | None = None
    """File whose first line is the secret with which posts are signed (HMAC-SHA-256)."""
    timeout_s: float = 5.0
    """Timeout in seconds for an answer to a post."""
    max_waiting: int = 1000
    """Maximum number of changes kept for an address that doesn't answer; the oldest are dropped."""
    max_retry_s: float = 30.0
    """Longest wait in seconds between attempts to post; the first wait is 0.2 s."""

    def __post_init__(self) -> None:
        expect_values(self, "webhooks.")
        expect_ranges(
            self, "webhooks.", timeout_s=(0.1, 600), max_waiting=(1, 100000), max_retry_s=(0.2, 3600)
        )
        for url in self.urls:
            if urlsplit(url).scheme not in ("http", "https") or not urlsplit(url).hostname:
                raise ConfigError(f"webhooks.urls: {url!r} is not an address; write https://HOST/PATH")
