"""Settings of the OPC UA server, from the table `[opcua]` of plant.toml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from barsight.core.errors import ConfigError
from barsight.core.settings.values import expect_ranges, expect_values

OPCUA_ROLES = ("viewer", "operator", "engineer")
"""A viewer reads, an operator also calls jobs, handshake and acknowledges, an engineer also recipes."""


@dataclass(frozen=True)
class OpcUaSettings:
    """The OPC UA server."""

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
    def nodeset(self) -> Path | None:
        """Find the NodeSet's file. Raises ConfigError where a folder is named that hasn't it."""
        if self.nodesets is None:
            return None
        path = self.nodesets / "Opc.Ua.MachineVision.NodeSet2.xml"
        if not path.is_file():
            raise ConfigError(f"{path}: no such file; {NODESET_REMEDY}")
        return path


NODESET_REMEDY = "run: npm install node-opcua-nodesets, and set opcua.nodesets to its folder `nodesets`"
