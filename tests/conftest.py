"""Where the real recordings lie; tests that need them skip elsewhere."""

import os
import shutil
from pathlib import Path

import pytest

from barsight.simulation.simulate import simulate
from cli_runs import TINY

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
