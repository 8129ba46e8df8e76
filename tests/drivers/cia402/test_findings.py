"""What the driver says about the bus before a motion."""

import numpy as np

from hil_drivers.arm import limits_of
from hil_drivers.cia402.can_cycle import Counts
from hil_drivers.cia402.session import outside_of


def test_what_has_gone_wrong_on_the_bus_is_told_with_its_number() -> None:
    told = str(Counts(missing=12, late=3, foreign=1))
    assert told == (
        "12 answers (TPDOs) missing, 3 of them late, 1 frames of nodes that are not ours"
    )
    assert str(Counts(doubled=2)) == "2 doubled"


def test_a_bus_on_which_nothing_went_wrong_is_not_spoken_of() -> None:
    assert str(Counts()) == ""


def test_a_joint_outside_of_its_range_is_named_with_the_figures() -> None:
    limits = limits_of("lab6")
    names = [f"joint_{axis + 1}" for axis in range(6)]
    assert outside_of(limits.q_max, limits, names) == []
    at = np.zeros(6)
    at[1] = limits.q_min[1] - 0.5
    (said,) = outside_of(at, limits, names)
    low, high = np.degrees([limits.q_min[1], limits.q_max[1]])
    assert said == (
        f"joint_2 is at {low - np.degrees(0.5):.1f}°, outside of its range of {low:.1f} to "
        f"{high:.1f}°"
    )
