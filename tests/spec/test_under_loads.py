"""The key `validate.under_loads` and its criteria: what goes together, and what it holds out."""

from __future__ import annotations

import pytest

from hil.core.errors import SpecError
from hil.spec.experiment import ExperimentSpec
from hil.spec.load import spec_from_text

FOURIER = "hil: 1\nname: a\nrobot: ur5\nexcitation: {kind: fourier, trajectories: 8}\n"
LOADS = "loads: [{mass_kg: 0}, {mass_kg: 1}, {mass_kg: 3}]\n"
FIT = "fit: [{estimator: rigid-wls}]\n"
ASKED = "validate: {under_loads: true, hold_out: {trajectories: 2}}\n"


def spec(*lines: str) -> ExperimentSpec:
    return spec_from_text("".join(lines))


def test_every_load_but_the_first_is_held_out_with_the_motions() -> None:
    held = spec(FOURIER, LOADS, FIT, ASKED).hold_out
    assert (held.loads, held.trajectories) == ((1, 2), 2)


def test_a_quarter_of_the_motions_is_held_out_unless_told() -> None:
    assert spec(FOURIER, LOADS, FIT, "validate: {under_loads: true}\n").hold_out.trajectories == 2


def test_without_it_is_held_out_what_is_written() -> None:
    held = spec(FOURIER, LOADS, FIT, "validate: {hold_out: {loads: [2]}}\n").hold_out
    assert (held.loads, held.trajectories) == ((2,), None)


@pytest.mark.parametrize(
    ("lines", "where", "told"),
    [
        ((FOURIER, FIT, ASKED), "validate.under_loads", "`loads` needs a second"),
        ((FOURIER, "loads: [{mass_kg: 3}]\n", FIT, ASKED), "validate.under_loads", "a second"),
        ((FOURIER, LOADS, ASKED), "validate.under_loads", "`fit` is empty"),
        (
            (FOURIER.replace("8", "2"), LOADS, FIT, "validate: {under_loads: true}\n"),
            "excitation.trajectories",
            "at least 3",
        ),
        (
            (FOURIER.replace("fourier, trajectories: 8", "dwell"), LOADS, FIT,
             "validate: {under_loads: true}\n"),
            "validate.under_loads",
            "a dwell program has none",
        ),
        (
            (FOURIER, LOADS, FIT, "validate: {under_loads: true, hold_out: {loads: [2]}}\n"),
            "validate.hold_out.loads",
            "leave this away",
        ),
        (
            (FOURIER, LOADS, FIT, "validate: {under_loads: true, hold_out: {trajectories: 0}}\n"),
            "validate.hold_out.trajectories",
            "holds out nothing",
        ),
        (
            (FOURIER, LOADS, FIT, "accept: {load_error_ratio: {max: 1.5}}\n"),
            "accept.load_error_ratio",
            "only with validate",
        ),
        (
            (FOURIER, LOADS, FIT, "accept: {contradicted_loads: {max: 0}}\n"),
            "accept.contradicted_loads",
            "only with validate",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_is_said_where_it_is(lines: tuple[str, ...], where: str, told: str) -> None:
    with pytest.raises(SpecError) as failed:
        spec(*lines)
    assert where in str(failed.value)
    assert told in str(failed.value)
