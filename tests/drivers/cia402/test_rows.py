"""Cycles of the bus as state rows and as raw rows."""

import numpy as np
import pytest

from hil.robot import Status, state_dtype
from hil.robot.state import Topic
from hil_drivers.cia402.mapping import ALL_MODES, MAPPINGS, POSITION
from hil_drivers.cia402.profile import AxisProfile, Scaling
from hil_drivers.cia402.rows import (
    LATE,
    STALLED,
    TOPIC,
    StateRows,
    cycle_dtype,
    raw_rows,
    raw_topic,
    raw_values,
)

N = 2
PERIOD_S = 0.004
ENABLED, FOLLOWS, LIMITED = 0x0237, 0x1000, 0x0800
GOOD = ENABLED | FOLLOWS
PROFILES = (
    AxisProfile(4096, 100.0, 5.0, 2.0),
    AxisProfile(1 << 20, 81.0, 3.0, 1.0, polarity=0xC0, offset_rad=0.3, direction=1),
)
SCALING = Scaling(PROFILES)


def cycles_of(mapping=POSITION, count=20, **values):
    """Cycles in which everything is fine, but for what is given: name → (count, N) or less."""
    cycles = np.zeros(count, cycle_dtype(mapping, N))
    cycles["cycle"] = np.arange(count)
    cycles["host_time"] = 1e9 + cycles["cycle"] * PERIOD_S
    values = {"statusword": GOOD, "mode_display": 8, "mode": 8} | values
    for side, pdos in (("rpdo", mapping.rpdos), ("tpdo", mapping.tpdos)):
        for at, pdo in enumerate(pdos):
            records = np.zeros((count, N, 1), pdo.dtype)
            for entry in pdo.entries:
                if entry.name in values:
                    value = np.asarray(values[entry.name])
                    records[entry.name][..., 0] = value[:, None] if value.ndim == 1 else value
            cycles[side][:, at] = records.view(np.uint8)
    for name in set(values) & set(cycles.dtype.names):
        cycles[name] = values[name]
    return cycles


def rows_of(cycles, mapping=POSITION, effort="torque", scaling=SCALING):
    return StateRows(mapping, scaling, PERIOD_S, effort).rows(cycles)


def busy(seed, mapping=ALL_MODES, count=60):
    """Cycles full of numbers, none of which is like the others."""
    random = np.random.default_rng(seed)
    cycles = np.zeros(count, cycle_dtype(mapping, N))
    for side in ("rpdo", "tpdo"):
        cycles[side] = random.integers(0, 256, cycles[side].shape)
    cycles["cycle"] = np.arange(count)
    cycles["segment"], cycles["status"] = random.integers(0, 9, (2, count))
    cycles["flags"] = random.random(count) < 0.2
    return cycles


@pytest.mark.parametrize("seed", range(5))
def test_blocks_of_any_cut_give_the_same_rows(seed):
    cycles = busy(seed)
    cuts = np.sort(np.random.default_rng(seed + 100).integers(0, len(cycles), 9))
    once, by_parts = rows_of(cycles, ALL_MODES), StateRows(ALL_MODES, SCALING, PERIOD_S)
    parts = [by_parts.rows(part) for part in np.split(cycles, cuts)]
    assert np.concatenate(parts).tobytes() == once.tobytes()


def test_a_row_has_the_set_point_sent_two_cycles_before_it():
    target = np.arange(20)[:, None] * np.array([10, 1000])
    rows = rows_of(cycles_of(target_position=target))
    assert rows["q_target"][2:] == pytest.approx(SCALING.position(target)[:-2])


def test_a_row_has_the_step_that_was_announced_with_its_set_point():
    rows = rows_of(cycles_of(segment=np.repeat([4, 5], 10), status=np.repeat([1, 2], 10)))
    assert rows["segment"].tolist() == [4] * 12 + [5] * 8
    assert rows["status"].tolist() == [1] * 12 + [2] * 8


def test_velocity_and_acceleration_of_set_points_are_those_of_the_motion():
    t = np.arange(200) * PERIOD_S
    q = 0.3 * np.sin(2 * t)[:, None] * np.ones(N)
    rows = rows_of(cycles_of(count=200, target_position=SCALING.raw_position(q)))
    at = t[1:-3]  # of the row's set-point: the first three have no motion before them
    assert rows["qd_target"][3:-1, 1] == pytest.approx(0.6 * np.cos(2 * at), abs=1e-3)
    assert rows["qdd_target"][3:-1, 1] == pytest.approx(-1.2 * np.sin(2 * at), abs=1e-2)


def test_the_first_rows_do_not_move():
    target = 1000 + np.arange(20)[:, None] * np.ones(N, int)
    rows = rows_of(cycles_of(target_position=target))
    assert (rows["qd_target"][:2] == 0).all()
    assert (rows["qdd_target"][:2] == 0).all()


def test_an_incomplete_cycle_leaves_no_row_and_is_flagged_among_the_raw_ones():
    flags = np.zeros(20, int)
    flags[7], flags[9] = 1 << 1, LATE
    cycles = cycles_of(flags=flags)
    rows = rows_of(cycles)
    raw = raw_rows(cycles, POSITION, raw_topic(POSITION, N, 250.0), PERIOD_S)
    assert np.rint(rows["device_time"] / PERIOD_S).tolist() == [k for k in range(20) if k != 7]
    assert (len(raw), raw["flags"].tolist()) == (20, flags.tolist())


@pytest.mark.parametrize(
    ("statusword", "status"),
    [
        (GOOD, 0),
        (ENABLED, Status.MASKED),
        (GOOD | LIMITED, Status.MASKED),
        (0x0233 | FOLLOWS, Status.MASKED),
        (0x0218, Status.MASKED | Status.FAULT),
        (0x021F, Status.MASKED | Status.FAULT),
    ],
)
def test_one_axis_that_does_not_follow_masks_the_row(statusword, status):
    words = np.full((20, N), GOOD)
    words[:, 1] = statusword
    rows = rows_of(cycles_of(statusword=words))
    assert (rows["status"] == int(status)).all()


def test_a_fault_has_the_code_of_its_emergency():
    code = np.zeros(20, int)
    code[10:] = 0x8611
    rows = rows_of(cycles_of(fault_code=code))
    assert rows["fault_code"].tolist() == code.tolist()
    assert ((rows["status"][10:] & int(Status.FAULT)) > 0).all()


def test_axes_in_different_modes_are_in_none():
    modes = np.full((20, N), 8)
    modes[5:, 1] = 10
    assert rows_of(cycles_of(mode_display=modes))["mode"].tolist() == [8] * 5 + [0] * 15


@pytest.mark.parametrize("effort", ["torque", "current"])
def test_effort_is_what_the_station_says(effort):
    raw = {"torque": np.full((20, N), 120), "current": np.full((20, N), -70)}
    rows = rows_of(cycles_of(**raw), effort=effort)
    assert rows["effort"] == pytest.approx(getattr(SCALING, effort)(raw[effort]))


def test_a_torque_is_commanded_in_cst_alone():
    said = np.full((20, N), 90)
    in_cst = cycles_of(ALL_MODES, mode_display=10, target_torque=said)
    in_csp = cycles_of(ALL_MODES, target_torque=said)
    assert rows_of(in_cst, ALL_MODES)["effort_target"] == pytest.approx(SCALING.torque(said))
    assert np.isnan(rows_of(in_csp, ALL_MODES)["effort_target"]).all()


def test_what_the_mapping_does_not_carry_is_not_measured():
    minimal = MAPPINGS["minimal"]
    rows = rows_of(cycles_of(minimal), minimal)
    assert np.isnan(rows["effort"]).all()
    assert (rows["status"] == 0).all()


def test_a_velocity_that_is_not_carried_is_the_difference_of_positions_over_missing_cycles_too():
    minimal, raw = MAPPINGS["minimal"], np.arange(20)[:, None] * np.array([1000, -3000])
    flags = np.zeros(20, int)
    flags[7:10] = 1
    raw[7:10] = raw[6]  # bytes of an earlier cycle
    cycles = cycles_of(minimal, position=raw, flags=flags)
    by_parts = StateRows(minimal, SCALING, PERIOD_S)
    rows = np.concatenate([by_parts.rows(part) for part in np.split(cycles, [5, 8, 12])])
    assert (rows["qd"][0] == 0).all()
    step = SCALING.position(raw[1]) - SCALING.position(raw[0])
    assert rows["qd"][1:] == pytest.approx(np.tile(step / PERIOD_S, (16, 1)))


@pytest.mark.parametrize("mapping", MAPPINGS.values(), ids=list(MAPPINGS))
def test_raw_rows_hold_every_integer_that_went_over_the_wire(mapping):
    cycles = busy(3, mapping)
    topic = raw_topic(mapping, N, 250.0)
    assert isinstance(topic, Topic)
    assert topic.name == TOPIC
    raw = raw_rows(cycles, mapping, topic, PERIOD_S)
    entries = [entry for pdo in mapping.pdos for entry in pdo.entries]
    for entry in entries:
        assert raw[entry.name].dtype.itemsize == entry.size
        assert (raw[entry.name] == raw_values(cycles, mapping)[entry.name]).all()
    assert {entry.name for entry in entries} < set(raw.dtype.names)


def test_rows_are_state_rows():
    assert rows_of(cycles_of()).dtype == state_dtype(N)
    assert rows_of(cycles_of(count=0)).dtype == state_dtype(N)


@pytest.mark.parametrize("cut", [6, 7, 8, 9])
def test_rows_around_a_sync_that_was_much_too_late_are_masked(cut):
    flags = np.zeros(20, int)
    flags[7] = STALLED | LATE
    cycles, by_parts = cycles_of(flags=flags), StateRows(POSITION, SCALING, PERIOD_S)
    rows = np.concatenate([by_parts.rows(part) for part in np.split(cycles, [cut])])
    assert np.flatnonzero(rows["status"] & int(Status.MASKED)).tolist() == [7, 8, 9]
