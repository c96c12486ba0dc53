"""Where the optional test data is: the folder PDIPC_DATA, else `shared/data` beside the repository."""

import os
from pathlib import Path

import pytest

FOLDER = Path(os.environ.get("PDIPC_DATA", Path(__file__).parents[2] / "shared" / "data"))


def path(name: str) -> Path:
    """The file `name` of the optional test data; skips the test where it is not there."""
    file = FOLDER / name
    if not file.exists():
        pytest.skip(f'the optional test data has no "{name}"; set PDIPC_DATA to its folder')
    return file
