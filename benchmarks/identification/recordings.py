"""The recorded robots as datasets: what a benchmark fits on and what it is judged on.

Every file is read by the public importer with the map it ships with, into a recording that is
thrown away again. Where a robot was recorded once, the recording is cut into whole contiguous
parts, the earlier to fit on and the later to judge on, with a gap between them.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

from benchmarks.identification.parts import cut, thinned
from hil.core.errors import DataError
from hil.data.dataset import Dataset
from hil.importers import import_recording
from hil.importers.sources import load_source

_ROOT = Path(__file__).resolve().parents[2]
MAPS = _ROOT / "experiments" / "maps"

UR10E_TRAIN = (
    "ur-20_02_10-30sec_12harm",
    "ur-20_02_12-40sec_12harm",
    "ur-20_02_12-50sec_12harm",
    "ur-20_02_05-20sec_8harm",
)
UR10E_VALIDATION = "ur-20_02_19_14harm50sec"
UR10E_LOADED = "ur-20_02_19_14harm50secLoad"

ONCE: dict[str, tuple[str, str, float | None]] = {
    "ur10": ("ur10/ur10_exciting_trajectory_first_half.csv", "ur10_unisa", None),
    "panda": ("panda", "panda_interleaved", 125.0),
    "kr300": ("kr300/traj_A_data.mat", "kr300_mat", None),
    "tx40": ("tx40", "tx40_motors", 500.0),
}
"""Robots recorded once: file, map, and the rate [Hz] to which 1 kHz and 5 kHz are thinned out."""


def folder() -> Path:
    """Where the recordings lie: `HIL_DATA`, or `shared/data` beside the checkout."""
    return Path(os.environ.get("HIL_DATA", _ROOT.parent / "shared" / "data"))


def missing(robot: str) -> str:
    """Why there is nothing to be had of a robot; empty when there is."""
    if (folder() / robot).is_dir():
        return ""
    return f"no recordings of the {robot} here: set HIL_DATA to the folder that holds them"


def ur10e_train() -> list[Dataset]:
    """Load the four training trajectories of the UR10e, in the windows of the authors."""
    return [_ur10e(name) for name in UR10E_TRAIN]


def ur10e_validation() -> Dataset:
    """Load the whole trajectory 14h50 without payload: evaluated, never tuned on."""
    return _ur10e(UR10E_VALIDATION)


def ur10e_loaded() -> Dataset:
    """Load the same trajectory with an undeclared payload of 2.805 kg."""
    return _ur10e(UR10E_LOADED)


def ur10() -> tuple[Dataset, Dataset]:
    """Load the run of the UR10, torques by the gains of its authors: to fit, to evaluate."""
    return cut(whole("ur10"))


def panda() -> tuple[Dataset, Dataset]:
    """Load the down-sampled run of the Panda: to fit, to evaluate."""
    return cut(whole("panda"))


def kr300() -> tuple[Dataset, Dataset]:
    """Load the run of the KR300, all six axes: to fit, to evaluate."""
    return cut(whole("kr300"))


def tx40() -> tuple[Dataset, Dataset]:
    """Load the down-sampled run of the TX40 in motor coordinates: to fit, to evaluate."""
    return cut(whole("tx40"))


@cache
def whole(robot: str) -> Dataset:
    """All of a robot that was recorded once; the dataset says which arm is its."""
    path, map_name, rate_hz = ONCE[robot]
    data = imported(path, map_name)
    return data if rate_hz is None else thinned(data, rate_hz)


@cache
def imported(path: str, map_name: str) -> Dataset:
    """One file below `folder()`, by its map.

    Raises:
        DataError: The file is not there.
    """
    source = folder() / path
    if not source.exists():
        raise DataError(f"there is no {source}", hint="set HIL_DATA to the folder of recordings")
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "recording.mcap"
        import_recording(source, map_file=MAPS / f"{map_name}.yaml", out=out)
        data = load_source(out)
    # The recording is gone: a series is known by the file it was imported from.
    conditions = tuple(replace(c, id=f"{source.stem}#{i}", source=source.stem)
                       for i, c in enumerate(data.conditions))  # fmt: skip
    return replace(data, conditions=conditions)


def _ur10e(name: str) -> Dataset:
    return imported(f"ur10e/{name}.csv", "ur10e_columns")
