"""Drives checked against the station and set up, every setting read back."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hil.core.errors import CommandRefused, RobotConnectionError
from hil_drivers.cia402.commissioning import configured, inspected, out_of_range
from hil_drivers.cia402.options import options_of
from hil_drivers.cia402.profile import AxisProfile
from hil_mock_robot.cia402.access_rules import DEVICE_STATE, NO_OBJECT, Abort
from hil_mock_robot.cia402.keys import key
from tests.support.cia402_drives import ARM, drives

GEAR, POLARITY, QUICK_STOP = key(0x6091, 1), key(0x607E), key(0x6085)


def options(n: int = 2, **given):
    told = options_of({"bus": {"interface": "hil_unix", "channel": "can0"}, **given}, "lab6")
    return replace(told, nodes=told.nodes[:n], axes=told.axes[:n])


def commissioned(line, **given):
    line.master.preoperational()
    told = options(len(line.nodes), **given)
    return configured(line.master, told, inspected(line.master, told, ARM))


def refused(line, **given) -> str:
    with pytest.raises(RobotConnectionError) as caught:
        commissioned(line, **given)
    assert "correct the station" in caught.value.hint
    return caught.value.message


def without(node, monkeypatch, *indices: int) -> None:
    """The drive loses objects."""
    for name in ("get_data", "set_data"):
        whole = getattr(node, name)

        def lacking(index, sub, *args, whole=whole, **more):
            if index in indices:
                raise Abort(NO_OBJECT)
            return whole(index, sub, *args, **more)

        monkeypatch.setattr(node, name, lacking)


def test_drives_of_the_mock_are_taken_as_they_are_and_scaled_by_their_own_objects():
    with drives(6) as line:
        found = commissioned(line)
    scaling = found.scaling
    # 6077h in ‰ of effort_max / 2.1 at the joint, but for rated torques in whole mN·m
    assert scaling.torque_resolution * 1000 == pytest.approx(ARM.effort_max / 2.1, rel=2e-3)
    assert scaling.drive_gains == pytest.approx(tuple(ARM.drive_gains), rel=4e-3)
    assert 2 * np.pi / scaling.position_resolution == pytest.approx(2**20 * ARM.gear_ratio)
    assert found.q_min == pytest.approx(ARM.q_min, abs=1e-6)
    assert found.q_max == pytest.approx(ARM.q_max, abs=1e-6)
    assert found.max_torque == pytest.approx(ARM.effort_max, rel=2e-3)
    assert [drive.objects["serial"] for drive in found.drives] == list(range(402_001, 402_007))


def test_every_setting_is_in_the_drive_afterwards():
    with drives() as line:
        commissioned(line, rate_hz=125, master_id=99, torque_limit_percent=150)
        for node in line.nodes:
            told = node.registers
            assert (told[key(0x60C2, 1)], told[key(0x60C2, 2)]) == (8, -3)
            assert told[key(0x1006)] == 8000
            assert (told[key(0x605A)], told[key(0x605E)], told[key(0x6007)]) == (2, 2, 3)
            assert told[key(0x1016, 1)] == 99 << 16 | 250
            assert told[key(0x1017)] == 100
            assert told[key(0x6066)] == 20
            assert told[key(0x6072)] == 1500


def test_the_following_error_window_is_the_angle_in_the_drives_increments():
    with drives(1) as line:
        commissioned(line, following_error_deg=3.0)
        assert line.nodes[0].registers[key(0x6065)] == round(3.0 / 360 * 121 * 2**20)


def test_our_heartbeat_is_watched_only_when_all_else_is_set():
    with drives(1) as line:
        commissioned(line)
        writes = [d for can_id, d in line.sent if can_id == 0x601 and d[0] >> 5 == 1]
        assert writes[-1][1:4] == b"\x16\x10\x01"


def test_what_is_so_already_is_not_written_again():
    with drives(1) as line:
        commissioned(line)
        line.sent.clear()
        inspected(line.master, options(1), ARM)
        assert [d for can_id, d in line.sent if can_id == 0x601 and d[0] >> 5 == 1] == []


def test_a_torque_limit_that_was_set_is_the_limit_that_is_told():
    with drives() as line:
        found = commissioned(line, torque_limit_percent=105)
    assert found.max_torque == pytest.approx(ARM.effort_max[:2] / 2, rel=2e-3)


def test_a_station_may_say_itself_what_the_drives_say():
    with drives() as line:
        axes = {"encoder_increments": 2**20, "gear_ratio": [121, 141, 121, 81, 81, 51]}
        assert commissioned(line, axes=axes).details["gear_ratio"] == "121 141"


def test_all_contradictions_are_told_at_once_by_joint_and_node():
    with drives() as line:
        axes = {"gear_ratio": [100, 141, 1, 1, 1, 1], "rated_current_a": 7.0, "polarity": 0x80}
        lines = refused(line, axes=axes).splitlines()
    assert [each.split(" contradicts ")[0] for each in lines] == [
        *["joint_1 (node 1)"] * 3,
        *["joint_2 (node 2)"] * 2,
    ]
    assert "contradicts the station: axes.gear_ratio is 100.0 in the station, 121.0" in lines[0]
    assert "axes.polarity is 128 in the station, 0 in the drive" in lines[1]
    assert "axes.rated_current_a is 7.0 in the station" in lines[2]


def test_a_drive_that_was_never_told_of_its_gear_needs_the_stations():
    with drives(1) as line:
        line.nodes[0].registers[GEAR] = 1
        assert "set axes.gear_ratio" in refused(line)
        assert commissioned(line, axes={"gear_ratio": 121}).details["gear_ratio"] == "121"


def test_a_gear_that_is_not_the_arms_is_refused_unless_the_station_says_it_too():
    with drives(1) as line:
        line.nodes[0].registers[GEAR] = 100
        told = refused(line)
        assert "reports a gear ratio of 100 (6091h), the gear ratio of the arm is 121" in told
        assert "axes.gear_ratio" in told
        assert commissioned(line, axes={"gear_ratio": 100}).details["gear_ratio"] == "100"


@pytest.mark.parametrize("mode", ["csp", "cst"])
def test_a_drive_without_the_mode_of_the_trajectories_is_refused(mode, monkeypatch):
    with drives() as line:
        monkeypatch.setitem(line.nodes[1].registers, key(0x6502), 1 << 0 | 1 << 8)
        told = refused(line, trajectory_mode=mode)
        assert told == (
            f"joint_2 (node 2) does not support {mode}: 6502h (supported modes) is 00000101h"
        )
        commissioned(line, trajectory_mode="csv")


def test_what_is_no_402_drive_is_refused_and_asked_no_further(monkeypatch):
    with drives() as line:
        monkeypatch.setitem(line.nodes[0].registers, key(0x1000), 0x0002_0191)
        told = refused(line)
    assert told == (
        "joint_1 (node 1) is not a CiA 402 drive: 1000h (device type) is 00020191h, "
        "its low word must be 0192h"
    )


def test_a_drive_without_rated_torque_needs_the_stations(monkeypatch):
    with drives(1) as line:
        without(line.nodes[0], monkeypatch, 0x6076)
        assert "defines rated_torque_nm; set axes.rated_torque_nm" in refused(line)
        assert commissioned(line, axes={"rated_torque_nm": 1.3}).scaling.torque_resolution[
            0
        ] == pytest.approx(1.3 * 121 / 1000)


def test_objects_that_a_drive_can_do_without_are_told_in_the_details(monkeypatch):
    with drives() as line:
        without(line.nodes[1], monkeypatch, 0x6007, 0x1006)
        found = commissioned(line)
    assert found.lacking == ((), ("1006h (cycle period)", "6007h (abort connection option)"))
    assert found.details["drives_lack"] == "1006h (cycle period), 6007h (abort connection option)"


@pytest.mark.parametrize("index", [0x60C2, 0x605A, 0x1016, 0x6065])
def test_a_drive_that_cannot_be_made_safe_is_refused(index, monkeypatch):
    with drives(1) as line:
        without(line.nodes[0], monkeypatch, index)
        with pytest.raises(CommandRefused, match=f"{index:04X}h.*no such object"):
            commissioned(line)


def test_a_setting_that_the_drive_rounds_is_refused(monkeypatch):
    with drives(1) as line:
        node, set_data = line.nodes[0], line.nodes[0].set_data

        def rounding(index, sub, data, **more):
            set_data(index, sub, b"\x05" if (index, sub) == (0x60C2, 1) else data, **more)

        monkeypatch.setattr(node, "set_data", rounding)
        with pytest.raises(CommandRefused, match=r"60C2h:01 .* reads 5 after 8 was written"):
            commissioned(line, rate_hz=125)


def test_limits_of_a_reversed_joint_stay_in_order_and_no_limits_are_nan():
    with drives() as line:
        line.nodes[1].registers[key(0x607D, 1)] = line.nodes[1].registers[key(0x607D, 2)] = 0
        found = commissioned(line, axes={"direction": -1})
    assert found.q_min[0] == pytest.approx(-ARM.q_max[0], abs=1e-6)
    assert found.q_max[0] == pytest.approx(-ARM.q_min[0], abs=1e-6)
    assert math.isnan(found.q_min[1])
    assert math.isnan(found.q_max[1])


def test_limits_of_a_counter_without_sign_are_those_around_the_joint():
    with drives(1) as line:
        zero, turn = 1 << 31, 121 << 20  # 0° where the counter stands at 2^31
        for sub, degrees in ((1, -90), (2, 60)):
            raw = zero + turn * degrees // 360
            line.nodes[0].registers[key(0x607D, sub)] = (raw + 2**31) % 2**32 - 2**31
        axes = {"position_unsigned": True, "offset_deg": -360 * zero / turn}
        found = commissioned(line, axes=axes)
    assert found.q_min == pytest.approx([math.radians(-90)], abs=1e-6)
    assert found.q_max == pytest.approx([math.radians(60)], abs=1e-6)


@pytest.mark.parametrize("ramp", [0, 100])
def test_a_quick_stop_that_takes_too_long_is_refused_with_the_least_that_would_do(ramp):
    with drives() as line:
        line.nodes[1].registers[QUICK_STOP] = ramp
        told = refused(line)
        assert told.startswith("joint_2 (node 2) brakes too slowly in a quick stop: 6085h")
        assert f"is {ramp}, which is" in told
        least = int(told.split("at least ")[1].split()[0])
        assert least == math.ceil(ARM.qd_max[1] / 0.5 * 141 * 2**20 / 2 / math.pi)
        line.nodes[1].registers[QUICK_STOP] = least
        assert commissioned(line).drives[1].quick_stop_s(ARM.qd_max[1]) == pytest.approx(0.5)


def test_the_station_may_say_what_6085h_means():
    with drives() as line:
        line.nodes[1].registers[QUICK_STOP] = 100
        found = commissioned(line, axes={"quick_stop_rad_s2": 12.0})
        assert found.drives[1].quick_stop_rad_s2 == 12.0


@pytest.mark.parametrize("ends", [(-(2**31), 2**31 - 1), (100, -100), (0, 0)])
def test_limits_that_limit_nothing_are_none(ends):
    with drives(1) as line:
        for sub, raw in zip((1, 2), ends, strict=True):
            line.nodes[0].registers[key(0x607D, sub)] = raw
        assert math.isnan(commissioned(line).q_min[0])


def test_a_range_that_no_counter_of_32_bits_holds_is_refused():
    axis = AxisProfile(1 << 31, 121.0, 1.0, 1.0, position_unsigned=True)
    assert list(out_of_range(replace(axis, encoder_increments=1 << 20), -3.0, 3.0)) == []
    assert len(list(out_of_range(axis, -3.0, 3.0))) == 1


def test_bits_of_polarity_that_are_the_vendors_own_say_nothing(monkeypatch):
    with drives(1) as line:
        monkeypatch.setitem(line.nodes[0].registers, POLARITY, 0x81)
        axis = commissioned(line, axes={"polarity": 0x80}).drives[0].profile
    assert axis.polarity == 0x80


def test_an_object_that_is_there_and_cannot_be_read_is_not_taken_for_missing(monkeypatch):
    with drives(1) as line:
        node, get_data = line.nodes[0], line.nodes[0].get_data

        def busy(index, sub, **more):
            if index == 0x6076:
                raise Abort(DEVICE_STATE)
            return get_data(index, sub, **more)

        monkeypatch.setattr(node, "get_data", busy)
        with pytest.raises(CommandRefused, match=r"6076h .* read: .* state of the device"):
            commissioned(line)


def test_a_range_that_32_bits_with_sign_do_not_hold_is_refused():
    with drives(1) as line:
        told = refused(line, axes={"offset_deg": 6100})
    assert "cannot represent -170 to 170°" in told
    with drives(1) as line:
        assert commissioned(line, axes={"offset_deg": 6100, "position_unsigned": True})


def test_an_el72xx_is_asked_for_its_torque_constant_and_how_it_counts_current(monkeypatch):
    with drives(1) as line:
        _beckhoff(line.nodes[0], monkeypatch, scaling=1)
        axis = commissioned(line, profile="el72xx").drives[0].profile
    # 0.5 N·m/A × rated current × gear, without √2
    rated_a = axis.rated_current_a
    assert 1000 * axis.nm_per_count == pytest.approx(0.5 * rated_a * 121)
    with drives(1) as line:
        _beckhoff(line.nodes[0], monkeypatch, scaling=0)
        axis = commissioned(line, profile="el72xx").drives[0].profile
    assert 1000 * axis.nm_per_count == pytest.approx(0.5 * rated_a * 121 / math.sqrt(2))


def test_where_torque_goes_by_current_the_rated_torque_may_say_what_it_will(monkeypatch):
    with drives(1) as line:
        axes = {"rated_torque_nm": 9.0}
        assert "rated_torque_nm is 9.0" in refused(line, axes=axes)
        _beckhoff(line.nodes[0], monkeypatch, scaling=0)
        assert commissioned(line, axes=axes, profile="el72xx")


def test_the_identity_keeps_objects_as_read_and_what_one_count_is():
    with drives() as line:
        details = commissioned(line).details
    assert details["encoder_increments"] == "1048576 1048576"
    assert details["rated_torque"] == "1299 1418"  # mN·m: 330 / 121 / 2.1, 420 / 141 / 2.1
    assert float(details["torque_resolution_nm"].split()[0]) == pytest.approx(0.157179)
    assert "statusword" not in details
    assert all(isinstance(value, str) for value in details.values())


def _beckhoff(node, monkeypatch, *, scaling: int) -> None:
    """The drive also has an EL72xx's 2002h:54 and 2003h:16 (500 mN·m/A)."""
    get_data = node.get_data
    vendor = {(0x2002, 0x54): scaling, (0x2003, 0x16): 500}

    def more(index, sub, **kept):
        if (index, sub) in vendor:
            return vendor[index, sub].to_bytes(4, "little")
        return get_data(index, sub, **kept)

    monkeypatch.setattr(node, "get_data", more)
