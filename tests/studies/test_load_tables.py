"""Tables and figures of a study of loads, from numbers made up for them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.estimators.payload import NAMES
from hil.studies.load_models import TOLD
from hil.studies.load_tables import TORQUES, WAYS, declarations, errors, figures, identified

LOADS = (0.0, 1.0, 3.0)
WORST = 11.0


def load(mass: float, inertia_known: bool) -> Any:
    """One load, identified 10 g too heavy and 1 mm and 0.001 kg·m² off."""
    error = {told: np.full(2, WORST if told == "unaware" else 0.5) for told in TOLD}
    declared = Payload(mass, (0.05, -0.01, 0.03)) if mass else Payload()
    case = SimpleNamespace(name=f"{mass:g} kg", declared=declared, told=mass or None)
    if not mass:
        bare = {told: error[told] for told in ("unaware", "declared")}
        return SimpleNamespace(case=case, errors=bare, check=None, estimate=None, failed="")
    off = np.array([0.01, *3 * [0.001], *6 * [0.001]])
    found = np.array([mass, *declared.com, *6 * [0.0]]) + off
    check = SimpleNamespace(
        found=found, limit=np.full(10, 0.1), findings=(), agrees=True, mount_observable=False,
        trusted=True,
    )  # fmt: skip
    determined = dict.fromkeys(NAMES, True) | dict.fromkeys(NAMES[4:], inertia_known)
    estimate = SimpleNamespace(determined=determined, values=found + 5.0)
    return SimpleNamespace(case=case, errors=error, check=check, estimate=estimate, failed="")


def model(name: str = "rigid-wls", inertia_known: bool = False) -> Any:
    """As if it had been judged."""
    return SimpleNamespace(name=name, loads=tuple(load(mass, inertia_known) for mass in LOADS))


def test_mass_and_centre_have_a_table_each_in_units_of_their_own() -> None:
    mass, centre = identified(model())
    assert mass.columns == centre.columns == (
        "load", "declared", "identified", "difference", "allowed ±",
    )  # fmt: skip
    assert [row[0] for row in mass.rows] == ["1 kg", "3 kg"]
    assert mass.rows[1][1:] == pytest.approx((3.0, 3.01, 0.01, 0.1))
    assert centre.rows[1][0] == "1 kg, y"
    assert centre.rows[1][1:] == pytest.approx((-10.0, -9.0, 1.0, 100.0))
    assert (mass.decimals, centre.decimals) == (3, 1)


def test_an_inertia_is_shown_only_where_it_is_determined() -> None:
    assert [table.key for table in identified(model())] == ["table-mass", "table-centre"]
    *_, inertia = identified(model(inertia_known=True))
    assert (inertia.key, len(inertia.rows)) == ("table-inertia", 12)
    assert inertia.rows[0][0] == "1 kg, xx"
    assert inertia.rows[0][2] == pytest.approx(1.0)


def test_the_note_says_how_a_weighing_relates() -> None:
    (note,) = (table.note for table in identified(model()) if table.note)
    assert "weighing before the motions" in note
    assert "one standard deviation" in note


def test_what_sets_the_scale_is_left_out_of_a_panel_beside() -> None:
    mean, _ = figures([model("a"), model("b")])
    assert [panel.title for panel in mean.panels] == [
        "a", "a, told of the load", "b", "b, told of the load",
    ]  # fmt: skip
    assert mean.per_row == 2
    for whole, aware in zip(mean.panels[::2], mean.panels[1::2], strict=True):
        assert [curve.name for curve in whole.curves] == list(TOLD)
        assert max(y for curve in aware.curves for y in curve.y if np.isfinite(y)) < WORST


def test_every_way_is_explained_where_it_is_drawn_and_listed() -> None:
    mean, _ = figures([model()])
    for told in TOLD:
        assert f"{told.capitalize()}: " in WAYS
    for text in (mean.caption, errors([model()]).note):
        assert WAYS in text
        assert TORQUES in text


def test_declarations_are_told_in_words_of_the_floor() -> None:
    assert declarations(model()).rows == tuple(
        (name, "agrees", "–", "no", "yes") for name in ("1 kg", "3 kg")
    )
