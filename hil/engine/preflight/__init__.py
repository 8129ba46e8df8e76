"""Checks before motion."""

from hil.engine.preflight.check import Check, CheckResult, Context, Situation
from hil.engine.preflight.preflight import (
    BUILT_IN,
    document_of,
    preflight,
    preflight_context,
    require_preflight,
    require_room_to_begin,
    require_waivable,
)

__all__ = [
    "BUILT_IN",
    "Check",
    "CheckResult",
    "Context",
    "Situation",
    "document_of",
    "preflight",
    "preflight_context",
    "require_preflight",
    "require_room_to_begin",
    "require_waivable",
]
