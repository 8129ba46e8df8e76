"""What the form of the start page asks for, looked at before anything is planned or started."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.core import SpecError
from hil.dashboard.checked import digest_of
from hil.dashboard.given_files import require_files_offered
from hil.dashboard.offered import file_offered
from hil.dashboard.settings import Settings
from hil.planning import commissioning_of, moves_for_real
from hil.workflow import check_start


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a form asks for, as it would be started now.

    Attributes:
        digest: As `hil.dashboard.checked` makes it.
        real: A real robot would move; its motion has to be confirmed.
    """

    spec: Path
    station: Path | None
    overrides: dict[str, str]
    operator: str
    speed: str
    first: str
    digest: str
    real: bool

    @property
    def asked(self) -> dict[str, Any]:
        """What is to be planned, see `hil.dashboard.planning.plan_apart`."""
        return {
            "spec": str(self.spec),
            "station": str(self.station or ""),
            "overrides": self.overrides,
            "speed": self.speed,
            "first": self.first,
        }


def wanted_in(given: Mapping[str, str], settings: Settings, who: str) -> Wanted:
    """What a form asks for; a mistake in it is told before anything is planned or started.

    Args:
        given: Its fields.
        settings: Says what is offered.
        who: Sits at the browser, where the form names nobody.

    Raises:
        HilError: Something cannot be so.
    """
    spec = file_offered(given.get("spec", ""), settings, "experiment", "series")
    named = given.get("station", "")
    station = file_offered(named, settings, "station") if named else None
    overrides = overrides_in(given.get("overrides", ""))
    require_files_offered(overrides, spec, settings)
    operator = given.get("operator", "").strip()[:80] or who
    require_text(operator, "the name of who is at the robot")
    speed, first = given.get("speed", "").strip(), given.get("first", "").strip()
    experiments = check_start(spec, station, overrides, commissioning_of(speed, first))
    digest = digest_of(experiments, speed, first)
    real = any(map(moves_for_real, experiments))
    return Wanted(spec, station, overrides, operator, speed, first, digest, real)


def overrides_in(text: str) -> dict[str, str]:
    """Lines `path=value`; empty ones say nothing.

    Raises:
        SpecError: A line says something else, or cannot be a text.
    """
    require_text(text, "what is laid over the spec", but="\r\n\t")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    pairs = [line.partition("=") for line in lines]
    for line, (path, equals, _) in zip(lines, pairs, strict=True):
        if not (equals and path.strip()):
            raise SpecError(f"{line!r} changes nothing", hint="a line is: excitation.waypoints=20")
    return {path.strip(): value.strip() for path, _, value in pairs}


def require_text(text: str, what: str, *, but: str = "") -> None:
    """Refuse control characters: no command line takes a NUL, and no name or value needs one.

    Args:
        text: What was typed, or sent by a program.
        what: What it is, for the message.
        but: Control characters it may have.

    Raises:
        SpecError: It has others.
    """
    found = sorted({c for c in text if unicodedata.category(c) == "Cc" and c not in but})
    if found:
        listed = ", ".join(f"U+{ord(c):04X}" for c in found)
        raise SpecError(f"{what} has control characters ({listed})", hint="type it anew")
