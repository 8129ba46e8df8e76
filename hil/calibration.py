"""Drive gains of recordings: sources in, gains out; `hil.identify.gains` sees datasets only."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hil.data.dataset import Dataset, SeriesKind
from hil.data.load import load_source
from hil.dynamics import load_model
from hil.errors import DataError
from hil.identify.gains import Gains, calibrate_gains


def gains_of_sources(sources: Sequence[Path], robot: str | None = None) -> Gains:
    """Drive gains from runs or files that hold the same dwells under loads of known mass.

    Args:
        sources: One run with several loads, or one source per load.
        robot: Built-in arm or URDF; by default what the data says.

    Raises:
        DataError: A source cannot be read, or they are of different robots.
        FitError: They do not tell the gains, see `calibrate_gains`.
    """
    if not sources:
        raise DataError("no recording was given", hint="hil gains RUN")
    kinds: tuple[SeriesKind, ...] = ("dwell", "trajectory")
    data = Dataset.concatenate([load_source(source, kinds=kinds) for source in sources])
    return calibrate_gains(data, load_model(robot or data.robot, gravity=data.gravity))
