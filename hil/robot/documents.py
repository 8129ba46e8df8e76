"""What crosses the line to a driver's process besides rows: facts, segments and errors, as JSON."""

from __future__ import annotations

import contextlib
import traceback
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray, HilError, RobotError, SpecError, StructArray, errors
from hil.robot.frames import garbage
from hil.robot.protocol import (
    Segment,
)

_TRACEBACK_LINES = 6
_MOST = 4000
"""Characters of a message at most: the answer to a stop is one packet."""

_TOLD_AS_THEY_ARE = (TypeError, ValueError)
"""What a constructor says that is called with options it does not have."""


@contextlib.contextmanager
def understood() -> Iterator[None]:
    """While inside, a document that is not what it should be raises `RobotConnectionError`."""
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise garbage(f"{type(error).__name__}: {error}") from error


def plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """A driver's options as JSON can carry them.

    Raises:
        SpecError: One holds what YAML has no plain value for, such as a date.
    """
    return {name: _plain(value, f"option {name}") for name, value in options.items()}


def _plain(value: Any, where: str) -> Any:
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, list | tuple):
        return [_plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: _plain(item, f"{where}.{key}") for key, item in value.items()}
    raise SpecError(
        f"{where}: {value!r} cannot be sent to a driver's process",
        hint="use numbers, text, lists and mappings with text keys; put dates into quotes",
    )


def payload_from(document: Mapping[str, Any]) -> Payload:
    """The other half of `dataclasses.asdict`."""
    return Payload(document["mass"], tuple(document["com"]), tuple(document["inertia"]))


def segment_document(segment: Segment) -> tuple[dict[str, Any], list[FloatArray]]:
    """A segment as a header and its set-points."""
    document = {
        "index": int(segment.index),
        "kind": segment.kind,
        "speed": float(segment.speed),
        "acceleration": float(segment.acceleration),
    }
    return document, [
        np.asarray(array, np.float64) for array in (segment.q, segment.qd, segment.qdd)
    ]


def segment_from(document: Mapping[str, Any], arrays: Sequence[StructArray]) -> Segment:
    """The other half of `segment_document`."""
    q, qd, qdd = arrays
    return Segment(q=q, qd=qd, qdd=qdd, **document)


def error_document(error: BaseException, doing: str) -> dict[str, str]:
    """An error as it crosses the line: the closest class of `hil.core.errors`, message and hint.

    Args:
        error: What a driver raised.
        doing: In which of its members.
    """
    if isinstance(error, HilError):
        # A driver's own subclass is unknown on the other side; what it specialises is not.
        kind = next(k.__name__ for k in type(error).__mro__ if k.__module__ == errors.__name__)
        return {"kind": kind, "message": error.message[:_MOST], "hint": error.hint[:_MOST]}
    if doing == "open" and isinstance(error, _TOLD_AS_THEY_ARE):
        kind = next(k.__name__ for k in _TOLD_AS_THEY_ARE if isinstance(error, k))
        return {"kind": kind, "message": str(error)[:_MOST], "hint": ""}
    lines = "".join(traceback.format_exception(error)).strip().splitlines()[-_TRACEBACK_LINES:]
    message = f"{doing}: unexpected {type(error).__name__}: {error}\n" + "\n".join(lines)
    return {"kind": "RobotError", "message": message[:_MOST], "hint": "this is a bug in the driver"}


def error_from(document: Mapping[str, Any]) -> Exception:
    """The error that `error_document` wrote; an unknown class becomes `RobotError`."""
    name, message, hint = (str(document[key]) for key in ("kind", "message", "hint"))
    for plain in _TOLD_AS_THEY_ARE:
        if name == plain.__name__:
            return plain(message)
    kind = getattr(errors, name, RobotError)
    known = isinstance(kind, type) and issubclass(kind, HilError)
    return (kind if known else RobotError)(message, hint=hint)
