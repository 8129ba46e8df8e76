"""What a validation says of the load of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hil.cli.output import fixed, print_table, say


def print_under_load(told: dict[str, Any]) -> None:
    """Errors by what the model is told of the load, and whether it is the one declared."""
    declared, found = told["declared"], told["identified"]
    n = len(told["rmse"]["unaware"])
    new = "a load that it was not fitted with, " if told["new"] else ""
    say(f"with {new}{_load(declared)} declared")
    print_table(
        ("RMSE filtered", *(f"J{j + 1}" for j in range(n)), "mean"),
        [_row(word, errors) for word, errors in told["rmse"].items()],
    )
    if found is None:
        say(f"  not identified: {told['failed']}")
        return
    say(f"  identified: {_load(found)}, mass ± {told['mass_std_kg']:.3f} kg by noise alone")
    if not told["agrees"]:
        say(f"  the declared load is CONTRADICTED: {'; '.join(told['contradictions'])}")
    elif told["unless_gains_are_wrong"]:
        say(
            "  the declared load is neither contradicted nor confirmed: by noise alone "
            f"{'; '.join(told['unless_gains_are_wrong'])},"
        )
        say(
            f"  but drive gains that are wrong may explain ±{told['mass_limit_kg']:.2f} kg; "
            "calibrated gains (hil gains) or a run with several loads would tell"
        )
    else:
        say("  the declared load agrees with it")
    if declared["mass_kg"] and not told["mount_observable"]:
        say("  its declared centre is on the flange's axis: no angle of its mount is checked")


def _load(told: dict[str, Any]) -> str:
    if not told["mass_kg"]:
        return "nothing"
    centre = ", ".join(fixed(x, 3) for x in told["com_m"])
    return f"{told['mass_kg']:.3f} kg at ({centre}) m"


def _row(told: str, errors: Sequence[float | None]) -> tuple[str, ...]:
    known = [error for error in errors if error is not None]
    mean = sum(known) / len(known) if known else None
    return (told, *("–" if error is None else f"{error:.4f}" for error in (*errors, mean)))
