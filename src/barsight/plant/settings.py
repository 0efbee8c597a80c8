"""Settings of the plant interface: the file plant.toml."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from barsight.core.errors import ConfigError
from barsight.core.settings.file import read_settings
from barsight.core.settings.values import expect_choice, expect_ranges, expect_values
from barsight.plant.link_settings import MqttSettings, OpcUaSettings, S7Settings, WebhookSettings

HELP_AT = "docs/how-to/connect-a-plant.md has an example"
LINKS = ("telegram", "opcua", "mqtt", "s7", "webhooks")
Link = TypeVar("Link", OpcUaSettings, MqttSettings, WebhookSettings)


@dataclass(frozen=True)
class StoreSource:
    """The store that is served, from the table `[store]`."""

    url: str = "sqlite:///barsight.db"
    """SQLAlchemy URL of the database."""
    approach_height_m: float | None = None
    """Height in metres at which the magnet's faces may travel over any place of the yard."""
    magnet_steps_kg: tuple[float, ...] = ()
    """Maximum load in kilograms for each step of the magnet's current, starting with step 1."""
    allow_simulated: bool = False
    """Also offer lifts of a simulated yard, to try out a PLC program; never with a real crane."""

    claim_s: float = 120.0
    """Time in seconds after which a crane's claim expires if the lift hasn't begun."""

    def __post_init__(self) -> None:
        expect_values(self, "store.")
        expect_ranges(self, "store.", claim_s=(1, 86400))
        if list(self.magnet_steps_kg) != sorted(set(self.magnet_steps_kg)):
            raise ConfigError("store.magnet_steps_kg: each step carries more than the one before")


@dataclass(frozen=True)
class TelegramSettings:
    """The server of the cyclic telegram, from the table `[telegram]`."""

    host: str = "127.0.0.1"
    """Address on which the server listens."""
    port: int = 2000
    """TCP port on which the server listens."""
    byte_order: str = "big"
    """Byte order of the telegram: `big` for S7, or `little`."""
    cycle_s: float = 0.1
    """Interval in seconds between telegrams."""
    silent_s: float = 0.3
    """Timeout in seconds: if the partner's life counter stands still for longer, the state is sent as
    invalid.
    """

    def __post_init__(self) -> None:
        expect_values(self, "telegram.")
        expect_choice("telegram.byte_order", self.byte_order, ("big", "little"))
        expect_ranges(self, "telegram.", port=(0, 65535), cycle_s=(0.01, 10), silent_s=(0.02, 60))


@dataclass(frozen=True)
class LiveSource:
    """A live run, from the table `[live]`: its mode may forbid lifts, and its pose is passed on."""

    folder: Path
    """OUT of `barsight live`; for a run with one survey after another, its `current` is used."""

    def __post_init__(self) -> None:
        expect_values(self, "live.")


@dataclass(frozen=True)
class PlantCrane:
    """The crane's encoders, from the table `[crane]`: the position that the PLC sends is used as the pose if
    no live run provides one.
    """

    position_std_m: float
    """Standard deviation in metres of the position that the PLC sends."""

    def __post_init__(self) -> None:
        expect_values(self, "crane.")
        expect_ranges(self, "crane.", position_std_m=(1e-5, 10))


@dataclass(frozen=True)
class PlantSettings:
    """All settings of plant.toml. A link is served if its table is present."""

    store: StoreSource = field(default_factory=StoreSource)
    live: LiveSource | None = None
    crane: PlantCrane | None = None
    telegram: TelegramSettings | None = None
    opcua: OpcUaSettings | None = None
    mqtt: MqttSettings | None = None
    s7: S7Settings | None = None
    webhooks: WebhookSettings | None = None

    @property
    def links(self) -> tuple[str, ...]:
        """Name the links that are served."""
        return tuple(name for name in LINKS if getattr(self, name) is not None)


def read_plant(path: Path) -> PlantSettings:
    """Read plant.toml; paths in it are relative to its folder. Raises InputError or ConfigError."""
    plant = read_settings(path, PlantSettings, HELP_AT, "config")
    if not plant.links:
        tables = ", ".join(f"[{name}]" for name in LINKS)
        raise ConfigError(f"{path}: names no link to serve; add one of {tables}; {HELP_AT}")
    at = path.absolute().parent
    return replace(
        plant,
        live=None if plant.live is None else LiveSource(at / plant.live.folder),
        opcua=None if plant.opcua is None else _beside(at, plant.opcua, "folder", "users", "nodesets"),
        mqtt=None if plant.mqtt is None else _beside(at, plant.mqtt, "password_file", "authority"),
        webhooks=None if plant.webhooks is None else _beside(at, plant.webhooks, "secret_file"),
    )


def _beside(at: Path, settings: Link, *names: str) -> Link:
    """Resolve paths against the folder of plant.toml."""
    paths = {name: getattr(settings, name) for name in names}
    return replace(settings, **{name: at / path for name, path in paths.items() if path is not None})
