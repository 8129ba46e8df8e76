"""What loads are called: by their mass, as people on the floor call them, not by their number."""

from __future__ import annotations

from typing import Any

from hil.report.documents import as_float, as_objects
from hil.report.facts import RunFacts


def load_name(facts: RunFacts, load: Any) -> str:
    """`3 kg`; `3 kg (load 2)` where that mass is mounted twice, `load 2` where none is known."""
    masses = [as_float(one.get("mass_kg")) for one in as_objects(facts.plan.get("loads"))]
    if not isinstance(load, int) or not 0 <= load < len(masses) or not masses[load] >= 0.0:
        return f"load {load}"
    name = f"{masses[load]:.4g} kg"
    return name if masses.count(masses[load]) == 1 else f"{name} (load {load})"
