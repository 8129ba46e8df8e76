"""Frame bits against the published worst case, bus load against the measured table."""

from __future__ import annotations

import pytest

from hil.can.frames import bus_load, frame_bits


@pytest.mark.parametrize("n_bytes", range(9))
def test_worst_case_is_that_of_the_schedulability_analysis(n_bytes: int) -> None:
    # Davis, Burns, Bril, Lukkien (2007), eqs. 1 and 2, with the interframe space.
    assert frame_bits(n_bytes).worst == 55 + 10 * n_bytes
    assert frame_bits(n_bytes, extended=True).worst == 80 + 10 * n_bytes


def test_a_frame_of_eight_bytes_without_stuffing_has_111_bits() -> None:
    assert frame_bits(8).nominal == 111
    assert frame_bits(8, extended=True).nominal == 131


@pytest.mark.parametrize("n_bytes", [-1, 9, 64])
def test_no_classic_frame_is_longer_than_eight_bytes(n_bytes: int) -> None:
    with pytest.raises(ValueError, match="0 to 8"):
        frame_bits(n_bytes)


@pytest.mark.parametrize(
    ("lengths", "nominal", "worst"),
    [
        ([0] + 12 * [6], 1187, 1435),
        ([0] + 12 * [7] + 6 * [8], 1949, 2365),
        ([0] + 18 * [8], 2045, 2485),
        ([0] + 12 * [6] + 6 * [7] + 6 * [8], 2471, 2995),
    ],
)
def test_load_of_six_axes_at_1_khz(lengths: list[int], nominal: int, worst: int) -> None:
    load = bus_load(lengths, 1000, 1e6)
    assert load == pytest.approx((nominal / 1000, worst / 1000))


def test_load_falls_with_the_rate_and_the_bit_rate() -> None:
    assert bus_load([8], 250, 1e6).worst == pytest.approx(bus_load([8], 500, 1e6).worst / 2)
    assert bus_load([8], 250, 5e5).worst == pytest.approx(bus_load([8], 250, 1e6).worst * 2)
