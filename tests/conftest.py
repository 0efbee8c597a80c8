"""Find the real recordings; tests that need them skip elsewhere."""

import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from barsight.simulation.simulate import simulate
from cli_runs import TINY

if TYPE_CHECKING:
    from barsight.store.opening import Store

DATA = Path(os.environ.get("BARSIGHT_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.fixture(scope="session")
def data() -> Path:
    if not DATA.is_dir():
        pytest.skip(f"no real recordings at {DATA} (set BARSIGHT_DATA)")
    return DATA


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("simulated") / "recording"
    simulate(path, TINY)
    return path


@pytest.fixture
def recording(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "recording"))


@pytest.fixture(scope="session")
def server() -> Iterator[str]:
    from store_servers import postgres  # here and below: other tests run without the extra `store`

    with postgres() as folder:
        yield folder


@pytest.fixture(params=["sqlite", "postgresql"])
def store_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """URL of an empty database: a file, or one of PostgreSQL where it is installed."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'yard.db'}"
    from store_servers import add_database

    return add_database(request.getfixturevalue("server"), f"yard_{uuid.uuid4().hex}")


@pytest.fixture
def store(store_url: str) -> Iterator["Store"]:
    from barsight.store.opening import open_store

    with open_store(store_url, create=True) as opened:
        yield opened


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a store for the page: a yard surveyed twice (`page_yards`)."""
    from page_yards import fill_store

    folder = tmp_path_factory.mktemp("made")
    fill_store(folder)
    return folder


@pytest.fixture
def url(made: Path, tmp_path: Path) -> str:
    """URL of a copy of that store on the same folders; its lifts were offered a minute ago."""
    shutil.copy(made / "yard.db", tmp_path / "yard.db")
    return f"sqlite:///{tmp_path / 'yard.db'}"
