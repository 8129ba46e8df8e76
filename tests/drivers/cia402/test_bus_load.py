"""How full the bus is, against a table worked out beforehand: 47 + 8n bits, and stuffing."""

from __future__ import annotations

import pytest

from hil.core.errors import SpecError
from hil_drivers.cia402.can_channel import cycle_lengths, load_of, most_rate_hz, require_room
from hil_drivers.cia402.mapping import ALL_MODES, MAPPINGS, MINIMAL, POSITION

MBIT = 1e6

# Six axes: frames of a cycle, bits without and with the worst stuffing, percent of 250 Hz, 1 Mbit.
TABLE = [
    (MINIMAL, 13, 1187, 1435, 30, 36),
    (POSITION, 19, 1949, 2365, 49, 59),
]


@pytest.mark.parametrize(("mapping", "frames", "nominal", "worst", "low", "high"), TABLE)
def test_six_axes_load_the_bus_as_worked_out(mapping, frames, nominal, worst, low, high):
    assert len(cycle_lengths(mapping, 6)) == frames
    cyclic = load_of(mapping, 6, 250.0, MBIT).cyclic
    assert cyclic.nominal * MBIT / 250 == pytest.approx(nominal)
    assert cyclic.worst * MBIT / 250 == pytest.approx(worst)
    assert (round(100 * cyclic.nominal), round(100 * cyclic.worst)) == (low, high)


def test_all_modes_are_25_frames_of_which_six_have_eight_bytes_more():
    # 47 + 6 × (103 + 111 + 103 + 111), 55 + 6 × (125 + 135 + 125 + 135)
    cyclic = load_of(ALL_MODES, 6, 1.0, 1.0).cyclic
    assert (cyclic.nominal, cyclic.worst) == (47 + 6 * 428, 55 + 6 * 520)


def test_beside_the_cycles_there_are_heartbeats_the_marker_and_sdo():
    beside = load_of(POSITION, 6, 250.0, MBIT).beside
    # 80 heartbeats of 55 to 65 bits, 10 markers of 95 to 115, 20 SDO frames of 111 to 135
    assert beside.nominal == pytest.approx((80 * 55 + 10 * 95 + 20 * 111) / MBIT)
    assert beside.worst == pytest.approx((80 * 65 + 10 * 115 + 20 * 135) / MBIT)


@pytest.mark.parametrize(
    ("mapping", "bitrate", "rate"),
    [
        (MINIMAL, 1e6, 500.0),
        (POSITION, 1e6, 1000 / 3),
        (ALL_MODES, 1e6, 250.0),
        (POSITION, 5e5, 1000 / 6),
        (ALL_MODES, 5e5, 125.0),
        (POSITION, 2e4, 0.0),
    ],
)
def test_the_largest_rate_that_fits(mapping, bitrate, rate):
    assert most_rate_hz(mapping, 6, bitrate) == pytest.approx(rate)
    if rate:
        assert load_of(mapping, 6, rate, bitrate).fits
        faster = 1000 / (1000 / rate - 1)
        assert not load_of(mapping, 6, faster, bitrate).fits


def test_what_does_not_fit_is_refused_with_the_rate_and_the_mapping_that_do():
    with pytest.raises(SpecError, match="500 Hz with mapping position do not fit") as caught:
        require_room("position", 6, 500.0, MBIT, MAPPINGS)
    assert "97% of the bus, 118% with the worst" in caught.value.message
    assert "rate_hz 333.333 is the largest" in caught.value.hint
    assert "with mapping minimal 500 Hz fit" in caught.value.hint


def test_a_kilohertz_fits_with_no_mapping():
    for name in MAPPINGS:
        with pytest.raises(SpecError) as caught:
            require_room(name, 6, 1000.0, MBIT, MAPPINGS)
        assert "with mapping" not in caught.value.hint


def test_on_a_slow_bus_heartbeats_count_too():
    # At 20 kbit/s they alone take 45 % at worst.
    slow = load_of(MINIMAL, 1, 20.0, 2e4)
    assert slow.cyclic.worst <= 0.8
    assert slow.total.worst > slow.cyclic.worst + 0.25
    busy = load_of(MINIMAL, 1, 50.0, 2e4)
    assert busy.cyclic.worst <= 0.8
    assert not busy.fits
