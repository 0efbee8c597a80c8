"""Settings of the links by OPC UA, MQTT, S7 and webhooks: the tables of plant.toml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from barsight.core.errors import ConfigError
from barsight.core.settings.values import expect_ranges, expect_values

OPCUA_ROLES = ("viewer", "operator", "engineer")
"""A viewer reads, an operator also calls jobs, handshake and acknowledges, an engineer also recipes."""


@dataclass(frozen=True)
class OpcUaSettings:
    """The OPC UA server, from the table `[opcua]` of plant.toml."""

    host: str = "127.0.0.1"
    """Address it listens at; 0.0.0.0 for every network of the computer."""
    port: int = 4840
    """TCP port."""
    folder: Path = Path("opcua")
    """Holds certificate, key, `trusted/` with the certificates of clients, and `revoked/` with CRLs."""
    users: Path | None = None
    """users.json, which `add_user` of barsight.plant.opcua.security.access writes. Without it nobody is more
    than a viewer."""
    nodesets: Path | None = None
    """Folder with Opc.Ua.MachineVision.NodeSet2.xml (npm's node-opcua-nodesets). None: variables only."""
    allow_anonymous: bool = True
    """Let anyone with a trusted certificate read."""
    allow_unsecured: bool = False
    """Let clients in without certificate and encryption. For a test bench only."""
    max_clients: int = 50
    """Connections at once."""
    max_subscriptions: int = 100
    """Subscriptions of all clients together, those of closed sessions counted in."""
    max_queue: int = 100
    """Values or events that wait for one client, a monitored item; the oldest go first."""
    max_unacknowledged: int = 20
    """Notifications a subscription keeps for a client that doesn't acknowledge them."""
    max_subscription_cycles: int = 600
    """Publishing cycles after which a subscription that nobody asks for is dropped."""
    state_every_s: float = 0.1
    """Interval between looks at the state."""
    kept_results: int = 20
    """Results that can be asked for; older ones go."""

    def __post_init__(self) -> None:
        expect_values(self, "opcua.")
        expect_ranges(
            self, "opcua.", port=(1, 65535), max_clients=(1, 1000), max_subscriptions=(1, 10000),
            max_queue=(1, 10000), max_unacknowledged=(1, 1000), max_subscription_cycles=(10, 15000),
            state_every_s=(0.01, 10), kept_results=(1, 1000),
        )  # fmt: skip

    @property
    def url(self) -> str:
        """Return the endpoint."""
        return f"opc.tcp://{self.host}:{self.port}/barsight"

    @property
    def nodeset(self) -> Path | None:
        """Find the NodeSet's file. Raises ConfigError where a folder is named that hasn't it."""
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
    """The broker."""
    port: int = 1883
    """Its TCP port; 8883 for TLS as a rule."""
    prefix: str = "barsight/crane"
    """Topics begin with it."""
    user: str | None = None
    """Name at the broker."""
    password_file: Path | None = None
    """A file with the password in its first line."""
    authority: Path | None = None
    """The broker's certificate authority (PEM); with it the connection is encrypted."""
    keepalive_s: int = 5
    """The broker tells the last will after 1.5 times so long without a sign of life."""
    max_waiting: int = 100
    """Events kept while the broker is away."""
    max_retry_s: float = 10.0
    """Longest wait between attempts to reach the broker; the first is 0.1 s."""
    state_every_s: float = 0.1
    """Least interval between states."""

    def __post_init__(self) -> None:
        expect_values(self, "mqtt.")
        expect_ranges(
            self, "mqtt.", port=(1, 65535), keepalive_s=(1, 3600), max_waiting=(1, 100000),
            max_retry_s=(0.1, 600), state_every_s=(0.01, 60),
        )  # fmt: skip
        if not self.prefix or set("#+\0") & set(self.prefix) or self.prefix.startswith("$"):
            raise ConfigError(
                f"mqtt.prefix: {self.prefix!r} is no topic; leave out #, + and a $ at the front"
            )


@dataclass(frozen=True)
class S7Settings:
    """The S7 client, from the table `[s7]` of plant.toml."""

    host: str = "127.0.0.1"
    """The PLC."""
    port: int = 102
    """Its TCP port."""
    rack: int = 0
    """Rack of the CPU."""
    slot: int = 1
    """Slot of the CPU: 1 for S7-1200 and S7-1500, 2 for S7-300."""
    read_db: int = 100
    """Data block that the PLC writes: encoders, hoist, magnet, clock, life counter."""
    read_start: int = 0
    """First byte there."""
    write_db: int = 101
    """Data block that Barsight writes."""
    write_start: int = 0
    """First byte there."""
    cycle_s: float = 0.1
    """Interval between exchanges."""
    silent_s: float = 0.3
    """The PLC's life counter may stand for so long."""
    max_retry_s: float = 5.0
    """Longest wait between attempts to reach the PLC."""

    def __post_init__(self) -> None:
        expect_values(self, "s7.")
        expect_ranges(
            self, "s7.", port=(1, 65535), rack=(0, 7), slot=(0, 31), read_db=(1, 65535),
            read_start=(0, 65535), write_db=(1, 65535), write_start=(0, 65535), cycle_s=(0.01, 10),
            silent_s=(0.02, 60), max_retry_s=(0.1, 600),
        )  # fmt: skip


@dataclass(frozen=True)
class WebhookSettings:
    """Webhooks for the yard management system: each change of the state is posted, as JSON."""

    urls: tuple[str, ...] = ()
    """Addresses, http or https; each gets all changes, in order."""
    secret_file: Path | None = None
    """A file with a secret in its first line, by which posts are signed (HMAC-SHA-256)."""
    timeout_s: float = 5.0
    """Wait for an answer."""
    max_waiting: int = 1000
    """Changes kept for an address that doesn't answer; the oldest go."""
    max_retry_s: float = 30.0
    """Longest wait between attempts; the first is 0.2 s."""

    def __post_init__(self) -> None:
        expect_values(self, "webhooks.")
        expect_ranges(
            self, "webhooks.", timeout_s=(0.1, 600), max_waiting=(1, 100000), max_retry_s=(0.2, 3600)
        )
        for url in self.urls:
            if urlsplit(url).scheme not in ("http", "https") or not urlsplit(url).hostname:
                raise ConfigError(f"webhooks.urls: {url!r} is no address; write https://HOST/PATH")
