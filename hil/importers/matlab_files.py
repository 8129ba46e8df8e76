"""Reading of MATLAB files: variables and struct fields, with the joints along either axis."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import DataError, FloatArray, did_you_mean
from hil.importers.foreign_samples import ForeignSamples
from hil.importers.import_map import Address, ImportMap

_INDEXED = re.compile(r"(.+)\[(\d+)\]")


class _Missing(DataError):
    """Error for a variable that does not exist in a file."""


def read_matlab(path: Path, layout: ImportMap) -> ForeignSamples:
    """Return the variables of a MATLAB file that are named in an import map.

    A quantity of the map is one variable with a row or column per joint (`rec.q`), or one address
    per joint (`rec.q[1]`: the first row or column, counted from 1).

    Raises:
        DataError: The file cannot be read, or a variable is missing or has an unexpected shape.
    """
    variables = _load(path)
    time = layout.columns.t
    columns: dict[str, FloatArray] = {}
    if time.rate_hz is None:
        if not time.columns:
            raise DataError(
                "the map contains neither a variable for t nor a rate",
                hint="add columns.t with a variable, or with rate_hz",
            )
        columns["t"] = np.ravel(_variable(variables, str(time.columns[0]), path))
    for name, quantity in layout.quantities().items():
        addresses = quantity.columns
        if addresses is None:
            raise DataError(
                f"the map names no variable for {name}", hint="add it to columns in the map"
            )
        try:
            columns[name] = _quantity(variables, addresses, layout.n_joints, path)
        except _Missing:
            if not quantity.optional:
                raise
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) != 1:
        raise DataError(
            f"{path}: the variables differ in length: {lengths}",
            hint="use variables of the same recording",
        )
    return ForeignSamples(columns, np.arange(1, lengths["q"] + 1), "sample")


def _load(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    try:
        variables: dict[str, Any] = loadmat(path, squeeze_me=True, struct_as_record=False)
    except NotImplementedError as error:
        raise DataError(
            f"{path} is a MATLAB 7.3 file, which is HDF5",
            hint="save it in MATLAB with: save(name, '-v7')",
        ) from error
    except (OSError, ValueError, TypeError, IndexError) as error:
        raise DataError(
            f"cannot read {path} as a MATLAB file: {error}",
            hint="save it with -v7; files of version 7.3 (HDF5) are not supported",
        ) from error
    return {name: value for name, value in variables.items() if not name.startswith("__")}


def _variable(variables: dict[str, Any], address: str, path: Path) -> FloatArray:
    """Return the array at a dotted path through nested structs."""
    place: Any = variables
    for step in address.split("."):
        fields = place if isinstance(place, dict) else getattr(place, "__dict__", {})
        known = [name for name in fields if not name.startswith("_")]
        if step not in known:
            raise _Missing(f"{path} has no variable {address!r}", hint=did_you_mean(step, known))
        place = fields[step]
    try:
        return np.asarray(place, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(
            f"{path}: the variable {address!r} is not numeric", hint="use a numeric array"
        ) from error


def _quantity(
    variables: dict[str, Any], addresses: tuple[Address, ...], n: int, path: Path
) -> FloatArray:
    if len(addresses) == 1:
        return _oriented(_variable(variables, str(addresses[0]), path), n, str(addresses[0]))
    if len(addresses) != n:
        raise DataError(
            f"the map gives {len(addresses)} variables for {n} joints",
            hint="give one variable per joint, or one for all",
        )
    return np.stack([_joint(variables, str(address), path) for address in addresses], axis=1)


def _joint(variables: dict[str, Any], address: str, path: Path) -> FloatArray:
    match = _INDEXED.fullmatch(address)
    if match is None:
        return np.ravel(_variable(variables, address, path))
    values, number = np.atleast_2d(_variable(variables, match[1], path)), int(match[2])
    joints = min(values.shape)
    if not 1 <= number <= joints:
        raise DataError(
            f"{address!r}: the variable has joints 1 to {joints}", hint="columns are counted from 1"
        )
    return _oriented(values, joints, address)[:, number - 1]


def _oriented(values: FloatArray, n: int, address: str) -> FloatArray:
    """Return an array with samples along the first axis; a square array is unchanged."""
    if values.ndim == 1:
        values = values[:, None]
    if values.ndim == 2 and values.shape[1] == n:
        return values
    if values.ndim == 2 and values.shape[0] == n:
        return np.ascontiguousarray(values.T)
    raise DataError(
        f"{address!r} is of shape {values.shape}, not samples × {n} joints",
        hint="use the variable with the positions, or transpose it in the file",
    )
