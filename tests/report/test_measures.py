"""Values with units, as a person reads them in passing."""

from __future__ import annotations

import numpy as np
import pytest

from hil.report.words import measure, measures, named, size

NARROW = "\u202f"


@pytest.mark.parametrize(
    ("value", "unit", "said"),
    [(0.35, "A", "0.350 A"), (4.658e-5, "rad", "0.0466 mrad"), (2e-7, "m", "0.200 µm"),
     (47137, "MB", "47.1 GB"), (0.5, "MB", "500 kB"), (999.9996, "MB", "1.00 GB"),
     (1234.4, "N·m", f"1{NARROW}234 N·m"), (21.5625, "°C", "21.6 °C"), (0, "rad", "0 rad"),
     (1e-5, "1", "< 0.001"), (-1e-5, "°C", "> -0.001 °C"), (3.25, None, "3.25"),
     (-3.2e-4, "A", "-0.320 mA")],
)  # fmt: skip
def test_a_value_has_the_unit_that_suits_it(value: float, unit: str, said: str) -> None:
    assert measure(value, unit) == said


@pytest.mark.parametrize("value", [None, "x", True, [1], float("nan"), float("inf"), 10**400])
def test_what_is_no_number_is_not_known(value: object) -> None:
    assert measure(value, "A") == "–"
    assert measures(value, 2.0, "A") == ("–", "2 A")
    assert measures(2.0, value, "A") == ("2.00 A", "–")


@pytest.mark.parametrize(
    ("value", "limit", "unit", "said"),
    [(4.658e-5, 0.02, "rad", ("0.0466 mrad", "20 mrad")),
     (4.658e-5, 0.5, "rad", ("< 0.001 rad", "0.5 rad")),
     (47137, 500, "MB", ("47.1 GB", "0.5 GB")),
     (0.3, 150.0, "N·m", ("0.300 N·m", "150 N·m")),
     (45.62, 142.5, "N·m", ("45.6 N·m", "142.5 N·m")),
     (12.3, 250, "mm", ("12.3 mm", "250 mm")),
     (45, 999.7, "N·m", ("45.0 N·m", "999.7 N·m")),
     (45, 1047.6, "N·m", ("45.0 N·m", f"1{NARROW}047.6 N·m")),
     (0.3, 0.0005, "rad", ("0.300 rad", "0.0005 rad")),
     (0.1, 0.312345, "rad", ("0.100 rad", "0.312345 rad")),
     (150.4, 150, "N·m", ("150.4 N·m", "150 N·m")),
     (-150.04, -150, "N·m", ("-150.04 N·m", "-150 N·m")),
     (0.02004, 0.02, "rad", ("20.04 mrad", "20 mrad")),
     (1000.4, 1000.2, "W", (f"1{NARROW}000.4 W", f"1{NARROW}000.2 W")),
     (0.04996, 0.05, "m", ("49.96 mm", "50 mm")),
     (150, 150, "N·m", ("150 N·m", "150 N·m")),
     (150 * (1 + 1e-15), 150, "N·m", ("150 N·m", "150 N·m"))],
)  # fmt: skip
def test_a_value_and_its_limit_are_in_one_unit(
    value: float, limit: float, unit: str, said: tuple[str, str]
) -> None:
    assert measures(value, limit, unit) == said


@pytest.mark.parametrize("value", [np.float32(3), np.float64(3), np.int64(3), 3])
def test_numbers_of_numpy_are_numbers(value: object) -> None:
    assert measure(value, "A") == "3.00 A"


def test_sizes_of_files() -> None:
    told = [size(n) for n in (0, 532, 999.6, 999_999, 46_338, 3e12)]
    assert told == ["0 B", "532 B", "1.00 kB", "1.00 MB", "46.3 kB", f"3{NARROW}000 GB"]
    assert [size(n) for n in (999.4, float("nan"), float("inf"))] == ["999 B", "–", "–"]


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [("velocity_rad_s", 1.639e-4, ("velocity", "0.164 mrad/s")),
     ("clearance_m", 0.021977, ("clearance", "0.0220 m")),
     ("effort_nm", 26.226, ("effort", "26.2 N·m")),
     ("ratio", None, ("ratio", "–"))],
)  # fmt: skip
def test_a_key_says_the_unit(key: str, value: object, said: tuple[str, str]) -> None:
    assert named(key, value) == said
