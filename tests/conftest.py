"""Where the real recordings lie; tests that need them skip elsewhere."""

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("BARSIGHT_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.fixture(scope="session")
def data() -> Path:
    if not DATA.is_dir():
        pytest.skip(f"no real recordings at {DATA} (set BARSIGHT_DATA)")
    return DATA
