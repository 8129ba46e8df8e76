"""The sample unpacked, and copies of it."""

from __future__ import annotations

import tarfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.frozen.frozen_parts import SAMPLE, entered


@pytest.fixture(scope="session")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample as it was written; no test changes it."""
    folder = tmp_path_factory.mktemp("frozen")
    with tarfile.open(SAMPLE) as archive:
        archive.extractall(folder, filter="data")
    return folder / "lab"


@pytest.fixture
def lab(unpacked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it that is the working directory."""
    return entered(unpacked, tmp_path, monkeypatch)


@pytest.fixture(scope="module")
def shared(unpacked: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The same for tests that only read."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        yield entered(unpacked, tmp_path_factory.mktemp("shared"), monkeypatch)
