"""Runs that are recorded once in a test session and shared by all tests and all workers.

The fixtures of `tests/conftest.py` give them; what a test changes is a copy of its own.
"""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from hil.models.model_registry import Registry, facts_of
from tests.support.command import hil
from tests.support.paths import EXPERIMENTS

DWELL = EXPERIMENTS / "ci_dwell_12.yaml"
FOURIER = EXPERIMENTS / "ci_fourier_2.yaml"
SLY = "<img src=x onerror=alert(1)>"
"""A text that would run, were it not escaped: the operator of the dwell program."""


def once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """Return a folder that `make` fills for the first of all workers that asks for it."""
    base = factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder, made = shared / name, shared / f"{name}.made"
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            made.touch()
    return folder


def dwells_in(folder: Path) -> None:
    """Record, fit, judge and register a dwell program."""
    _recorded(DWELL, folder)
    model = model_of(run_in(folder))
    Registry(folder / "registry").register("ur5", model, facts_of(model))


def trajectories_in(folder: Path) -> None:
    """Record, fit and judge a Fourier program."""
    _recorded(FOURIER, folder)


def _recorded(spec: Path, folder: Path) -> None:
    """Run a program; keep the document that its command prints as `report.json`."""
    said = hil("run", spec, "--runs", folder / "runs", "--operator", SLY, "--json")
    assert said.returncode == 0, said.stderr
    (folder / "report.json").write_text(said.stdout, "utf-8")


def run_in(folder: Path, name: str = "0*") -> Path:
    """Return the only run below a folder's `runs`, or the only one of that name."""
    (found,) = (folder / "runs").glob(f"*/*/{name}")
    return found


def model_of(run: Path) -> Path:
    """Return the folder of a run's only model."""
    (found,) = (run / "fit").iterdir()
    return found
