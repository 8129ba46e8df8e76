"""The identity of a spec: a hash of what it says, not of how it is written."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from hil.core import SpecError
from hil.spec.experiment import ExperimentSpec
from hil.spec.interlocks import SpeedScalingInterlock

_NEWER = (
    ("study",),
    ("excitation", "optimise"),
    ("validate", "under_loads"),
    ("validate", "hold_out", "trajectories_percent"),
    ("accept", "load_error_ratio"),
    ("accept", "contradicted_loads"),
)
"""Keys that came after runs were hashed, and where; unused they count as not there."""

_NEWER_DEFAULTS = [SpeedScalingInterlock(kind="speed_scaling").model_dump(mode="json")]
"""Interlocks that watch by default since then; as they are by default they leave no trace."""


def spec_hash(spec: ExperimentSpec) -> str:
    """sha256 of the canonical JSON of the spec, defaults included.

    What a spec does not use of studies, optimised excitation, judging under loads and drawn
    trajectories leaves no trace: it has the hash it had before there were any, and runs of an
    older hil go on.
    Comments, order of keys and of interlocks, spelling of numbers (`1` and `1.0`) and written-out
    defaults do not change it. A file of poses counts with its content, not with its path, so that
    the hash is the same on every machine.

    Raises:
        SpecError: The file of poses cannot be read.
    """
    raw = spec.model_dump(mode="json", by_alias=True)
    raw["interlocks"] = [each for each in raw["interlocks"] if each not in _NEWER_DEFAULTS]
    raw["interlocks"].sort(key=lambda interlock: json.dumps(interlock, sort_keys=True))
    for *parts, key in _NEWER:
        at = raw
        for part in parts:
            at = at[part]
        if not at.get(key):
            at.pop(key, None)
    if file := raw["excitation"].get("file"):
        raw["excitation"]["file"] = _content_hash(Path(file))
    text = json.dumps(_canonical(raw), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _canonical(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _canonical(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_canonical(item) for item in value]
    # Integral floats become ints; beyond 2**53 a float is not one particular integer any more.
    if isinstance(value, float) and abs(value) < 2**53 and value.is_integer():
        return int(value)
    return value


def _content_hash(file: Path) -> str:
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise SpecError(
            f"{file}: cannot be read: {error.strerror}",
            hint="see whether it exists and may be read",
        ) from None
