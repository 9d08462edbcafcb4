"""Shared fixtures. Real material is read in place and never copied into the project."""

import os
from pathlib import Path

import pytest

# One thread per worker: two workers on two cores, and results that do not depend on the machine.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")


def real_data_folder() -> Path:
    """Where the real videos and weights lie: ``$ANIMATIC_REAL_DATA``, else ``../shared/real`` beside the project."""
    given = os.environ.get("ANIMATIC_REAL_DATA")
    return Path(given) if given else Path(__file__).resolve().parents[2] / "shared" / "real"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real material; the test skips where it is absent."""
    folder = real_data_folder()
    if not folder.is_dir():
        pytest.skip(f"no real material: {folder} is not there; set ANIMATIC_REAL_DATA to its folder")
    return folder


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every test that takes the ``real_data`` fixture."""
    for item in items:
        if "real_data" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.real_data)
