"""What the driver says about the bus before a motion."""

from hil_drivers.cia402.findings import counted
from hil_drivers.cia402.node_watch import Counts


def test_what_has_gone_wrong_on_the_bus_is_told_with_its_number() -> None:
    told = counted(Counts(missing=12, late=3, foreign=1))
    assert told == (
        "12 answers (TPDOs) missing, 3 of them late, 1 frames of nodes that are not ours"
    )
    assert counted(Counts(doubled=2)) == "2 doubled"


def test_a_bus_on_which_nothing_went_wrong_is_not_spoken_of() -> None:
    assert counted(Counts()) == ""
