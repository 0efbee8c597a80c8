"""Settings of the plant's side: the file plant.toml."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from barsight.core.errors import ConfigError
from barsight.core.settings.file import read_settings
from barsight.core.settings.values import expect_choice, expect_ranges, expect_values

HELP_AT = "docs/how-to/connect-a-plant.md has an example"


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
class PlantSettings:
    """All of plant.toml that the telegram's process reads."""

    store: StoreSource = field(default_factory=StoreSource)
    telegram: TelegramSettings = field(default_factory=TelegramSettings)


def read_plant(path: Path) -> PlantSettings:
    """Read plant.toml. Raises InputError or ConfigError."""
    return read_settings(path, PlantSettings, HELP_AT, "config")
