"""What a friction network sees of a dwell, by the names people write into a spec.

- `q2`: a column of the dataset and the number of a joint, from 1;
- `approach`: +1 or −1, from which side the pose was approached; 0 where that is not known;
- `history`: any other column (N, n) of the dataset as a whole, n inputs;
- `own:history`: of such a column only the joint whose network it is, 1 input.

Not the effort itself, in none of its forms: a network that is shown the current predicts nothing.
The commanded effort is no better: at rest it is the measured one without the noise.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from hil.core import DataError, FitError, FloatArray, SpecError
from hil.data import Dataset

APPROACH = "approach"
OWN = "own:"
TARGETS = ("effort", "current", "torque")
"""Columns whose names hold one of these are what is to be predicted, or made of it."""

_NUMBERED = re.compile(r"([A-Za-z_]+)(\d+)")


def checked_names(names: Any) -> list[str]:
    """Names as a list.

    Raises:
        SpecError: It is no list of names, is empty, a name occurs twice, or it is the effort.
    """
    if isinstance(names, str) or not isinstance(names, list | tuple) or not names:
        raise SpecError(f"inputs is {names!r}, but must be a list of names such as [q2, approach]")
    wrong = [name for name in names if not isinstance(name, str) or not name]
    if wrong:
        raise SpecError(f"inputs: {wrong[0]!r} is no name of a column")
    if len(set(names)) != len(names):
        raise SpecError(f"inputs: {max(names, key=names.count)} is there twice")
    _require_no_target(names)
    return list(names)


def _require_no_target(names: list[str] | tuple[str, ...]) -> None:
    for name in names:
        if any(target in name.lower() for target in TARGETS):
            raise SpecError(
                f"inputs: {name!r} is the effort that is to be predicted, or made of it: the model "
                "would be given its answer",
                hint="use positions, velocities, temperature, approach, or columns of your own "
                "that are known without measuring or commanding an effort",
            )


def positions_only(names: list[str]) -> bool:
    """Whether the inputs follow from the joint positions alone."""
    return all(name == "q" or re.fullmatch(r"q\d+", name) for name in names)


def network_inputs(dataset: Dataset, names: list[str]) -> FloatArray:
    """(N, d) inputs, or (n, N, d) when joints have inputs of their own.

    Raises:
        DataError: The dataset has no such column, or the robot no such joint.
    """
    parts = [_columns(dataset, name) for name in names]
    if all(part.ndim == 2 for part in parts):
        return np.concatenate(parts, axis=1)
    joints = dataset.n_joints
    shared = [np.broadcast_to(p, (joints, *p.shape)) if p.ndim == 2 else p for p in parts]
    return np.concatenate(shared, axis=2)


def require_layout(X: FloatArray, first: int, names: list[str]) -> None:
    """Refuse inputs (N, d) or (n, N, d) that are more or fewer than the first of the layers.

    Raises:
        FitError: They are.
    """
    if X.shape[-1] != first:
        raise FitError(
            f"layers begins with {first}, but {', '.join(names)} are {X.shape[-1]} inputs",
            hint=f"use layers: [{X.shape[-1]}, …]",
        )


def position_inputs(q: FloatArray, names: list[str]) -> FloatArray:
    """(N, d) inputs that follow from positions (N, n) alone, see `positions_only`."""
    return np.concatenate(
        [q if name == "q" else q[:, int(name[1:]) - 1, None] for name in names], 1
    )


def _columns(dataset: Dataset, name: str) -> FloatArray:
    """(N, k), or (n, N, 1) for a joint's own."""
    if name.startswith(OWN):
        values = _column(dataset, name.removeprefix(OWN))
        if values.shape[1] != dataset.n_joints:
            raise DataError(f"input {name}: the column does not have one value per joint")
        return np.ascontiguousarray(values.T)[:, :, None]
    numbered = _NUMBERED.fullmatch(name)
    if name == APPROACH or name in dataset.columns or numbered is None:
        return _column(dataset, name)
    values, joint = _column(dataset, numbered[1]), int(numbered[2])
    if not 1 <= joint <= values.shape[1]:
        raise DataError(
            f"input {name}: there is no joint {joint}",
            hint=f"joints are counted from 1 to {values.shape[1]}",
        )
    return values[:, joint - 1 : joint]


def _column(dataset: Dataset, name: str) -> FloatArray:
    """(N, k)."""
    if name == APPROACH and name not in dataset.columns:
        sides = np.array([c.approach for c in dataset.conditions], dtype=np.float64)
        return sides[dataset.series_index()][:, None]
    try:
        values = dataset[name]
    except DataError as error:
        raise DataError(
            f"input {name!r} of the network: {error.message}", hint=error.hint
        ) from error
    return values.reshape(len(dataset), -1)
