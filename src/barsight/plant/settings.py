"""Settings of the plant's side: the file plant.toml."""

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
    """SQLAlchemy's URL of the database."""
    approach_height_m: float | None = None
    """The magnet's faces may travel over any place of the yard at this height."""
    magnet_steps_kg: tuple[float, ...] = ()
    """Most load of each step of the magnet's current, from step 1."""
    allow_simulated: bool = False
    """Offer lifts of a simulated yard too, to try a PLC's program; never with a crane."""

    def __post_init__(self) -> None:
        expect_values(self, "store.")
        if list(self.magnet_steps_kg) != sorted(set(self.magnet_steps_kg)):
            raise ConfigError("store.magnet_steps_kg: each step carries more than the one before")


@dataclass(frozen=True)
class TelegramSettings:
    """The cyclic telegram's server, from the table `[telegram]`."""

    host: str = "127.0.0.1"
    """Address it listens at."""
    port: int = 2000
    """Its TCP port."""
    byte_order: str = "big"
    """`big` for S7, or `little`."""
    cycle_s: float = 0.1
    """Interval between telegrams."""
    silent_s: float = 0.3
    """The partner's life counter may stand for so long."""

    def __post_init__(self) -> None:
        expect_values(self, "telegram.")
        expect_choice("telegram.byte_order", self.byte_order, ("big", "little"))
        expect_ranges(self, "telegram.", port=(0, 65535), cycle_s=(0.01, 10), silent_s=(0.02, 60))


@dataclass(frozen=True)
class LiveSource:
    """A live run, from the table `[live]`: its mode may forbid lifts, and its pose is passed on."""

    folder: Path
    """OUT of `barsight live`."""

    def __post_init__(self) -> None:
        expect_values(self, "live.")


@dataclass(frozen=True)
class PlantSettings:
    """All of plant.toml. A link is served where its table is there."""

    store: StoreSource = field(default_factory=StoreSource)
    live: LiveSource | None = None
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
    """Read plant.toml; paths in it are relative to it. Raises InputError or ConfigError."""
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
