"""Options of a station with CiA 402 drives: what they become, what is refused and what is right."""

from __future__ import annotations

import math

import pytest

from hil.can.frames import pack_frame
from hil.core.errors import SpecError
from hil_drivers.cia402.can_channel import SIMULATED, BusLog
from hil_drivers.cia402.options import options_of

BUS = {"interface": "hil_unix", "channel": "can7"}
REAL = {"interface": "socketcan", "channel": "can0"}


def options(**given):
    return options_of({"bus": BUS, **given}, "lab6")


def refused(**given) -> SpecError:
    with pytest.raises(SpecError) as caught:
        options_of(given, "lab6")
    assert caught.value.hint
    return caught.value


def test_a_bus_is_all_that_must_be_said():
    told = options_of({"bus": REAL}, "lab6")
    assert told.nodes == (1, 2, 3, 4, 5, 6)
    assert (told.rate_hz, told.mapping, told.trajectory_mode) == (250.0, "position", "csp")
    assert (told.pace, told.free, told.wall_period_s) == (1.0, False, 0.004)
    assert told.bus.bitrate == 1_000_000


def test_what_is_none_is_not_given():
    assert options(torque_limit_percent=None, rate_hz=None) == options()


@pytest.mark.parametrize(
    ("given", "said", "hint"),
    [
        ({}, "needs the option bus", "interface: socketcan"),
        ({"bus": {"interface": "hil_unix"}}, "bus is", "give channel too"),
        ({"bus": {**BUS, "bitrat": 1}}, "bus of the driver cia402 has no key bitrat", "'bitrate'?"),
        ({"bus": {**BUS, "interface": "hil-unix"}}, "bus.interface", "did you mean 'hil_unix'?"),
        ({"bus": {**REAL, "bitrate": 2_000_000}}, "bus.bitrate is 2000000", "10000 to 1000000"),
        ({"bus": "can0"}, "bus is 'can0'", "keys and values"),
        ({"bus": BUS, "node": [1]}, "no option node", "did you mean 'nodes'?"),
        ({"bus": BUS, "nodes": [1, 2, 3]}, "nodes is", "the 6 joints"),
        ({"bus": BUS, "nodes": [1, 2, 3, 4, 5, 5]}, "nodes is", "a different node id"),
        ({"bus": BUS, "nodes": [1, 2, 3, 4, 5, 127]}, "nodes is 127", "1 to 126"),
        ({"bus": BUS, "master_id": 3}, "nodes is", "3 is master_id"),
        ({"bus": BUS, "master_id": 0}, "master_id is 0", "1 to 127"),
        ({"bus": BUS, "rate_hz": 300}, "rate_hz is 300", "use 250 or 333.333"),
        ({"bus": BUS, "rate_hz": True}, "rate_hz is True", "4 to 1000"),
        ({"bus": BUS, "mapping": "postion"}, "mapping is 'postion'", "did you mean 'position'?"),
        ({"bus": BUS, "trajectory_mode": "CSP"}, "trajectory_mode is", "did you mean 'csp'?"),
        ({"bus": BUS, "feed_forward": "yes"}, "feed_forward is 'yes'", "true or false"),
        ({"bus": BUS, "pace": "fast"}, "pace is 'fast'", "or free"),
        ({"bus": BUS, "pace": 0}, "pace is 0", "0.1 to 1000"),
        ({"bus": BUS, "stop_rad_s2": math.nan}, "stop_rad_s2 is nan", "0.5 to 100"),
        ({"bus": BUS, "payload_object": 0x1000}, "payload_object is 4096", "8192 to 24575"),
        ({"bus": BUS, "late_cycles": 2.5}, "late_cycles is 2.5", "whole number"),
        ({"bus": BUS, "profile": "el7211"}, "profile is 'el7211'", "did you mean 'el72xx'?"),
        ({"bus": BUS, "eds": "no-such.eds"}, "eds is 'no-such.eds'", "the file does not exist"),
        ({"bus": BUS, "axes": {"gear_ration": 3}}, "no key gear_ration", "'gear_ratio'?"),
        ({"bus": BUS, "axes": {"gear_ratio": [1, 2]}}, "axes.gear_ratio", "a list of 6"),
        ({"bus": BUS, "axes": {"gear_ratio": -3}}, "axes.gear_ratio is -3", "0.01 to 10000"),
        ({"bus": BUS, "axes": {"polarity": 1}}, "axes.polarity is 1", "32, 64"),
        ({"bus": BUS, "axes": {"direction": True}}, "axes.direction is True", "1, -1"),
        ({"bus": BUS, "axes": {"velocity_unit": "RPM"}}, "velocity_unit", "did you mean 'rpm'?"),
        ({"bus": BUS, "axes": {"position_unsigned": 1}}, "position_unsigned is 1", "true or"),
        ({"bus": BUS, "axes": 3}, "axes is 3", "keys and values"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_with_what_would_be_right(given, said, hint):
    error = refused(**given)
    assert said in error.message
    assert hint in error.hint


@pytest.mark.parametrize(
    ("given", "mapping"),
    [
        ({}, "position"),
        ({"feed_forward": True}, "all-modes"),
        ({"trajectory_mode": "cst"}, "all-modes"),
        ({"trajectory_mode": "csv"}, "all-modes"),
        ({"mapping": "minimal", "rate_hz": 500}, "minimal"),
        ({"mapping": "all-modes"}, "all-modes"),
    ],
)
def test_the_mapping_carries_what_is_needed_unless_one_is_chosen(given, mapping):
    assert options(**given).mapping == mapping


@pytest.mark.parametrize(
    "given",
    [
        {"mapping": "minimal", "trajectory_mode": "cst"},
        {"mapping": "position", "trajectory_mode": "csv"},
        {"mapping": "minimal", "feed_forward": True},
        {"mapping": "position", "feed_forward": True},
    ],
)
def test_a_mapping_that_lacks_what_is_asked_for_is_refused(given):
    assert "needs all-modes" in refused(bus=BUS, **given).hint


def test_feed_forward_belongs_to_position_control():
    assert "60B2h" in refused(bus=BUS, feed_forward=True, trajectory_mode="cst").hint


@pytest.mark.parametrize("pace", [2, 0.5, "free"])
def test_time_runs_at_another_pace_on_simulated_buses_only(pace):
    assert options(pace=pace).pace == (0.0 if pace == "free" else pace)
    assert "run in real time" in refused(bus=REAL, pace=pace).hint


def test_simulated_drives_may_be_late_for_longer_than_real_ones():
    assert options(bus=REAL).late_cycles == 3
    assert {options(bus={**BUS, "interface": each}).late_cycles for each in SIMULATED} == {50}
    assert options(late_cycles=7).late_cycles == options(bus=REAL, late_cycles=7).late_cycles == 7


def test_cycles_of_a_faster_pace_take_less_wall_time_and_the_same_device_time():
    told = options(pace=4)
    assert (told.period_s, told.period_us, told.wall_period_s) == (0.004, 4000, 0.001)
    assert options(pace="free").wall_period_s == 0.0


def test_a_rate_that_does_not_fit_on_the_bus_is_refused_with_those_that_do():
    error = refused(bus=BUS, rate_hz=500)
    assert "rate_hz 333.333 is the largest" in error.hint
    assert "mapping minimal" in error.hint
    assert "mapping minimal" not in refused(bus=BUS, rate_hz=500, trajectory_mode="cst").hint


def test_a_simulated_bus_may_be_told_more_bits_than_any_wire_has():
    assert options(bus={**BUS, "bitrate": 10_000_000}, rate_hz=1000).rate_hz == 1000.0


def test_a_value_for_all_axes_or_one_for_each():
    told = options(axes={"gear_ratio": [10, 20, 30, 40, 50, 60], "rated_current_a": 2.5})
    assert [axis["gear_ratio"] for axis in told.axes] == [10, 20, 30, 40, 50, 60]
    assert {axis["rated_current_a"] for axis in told.axes} == {2.5}


def test_offsets_are_angles_and_each_axis_knows_the_middle_of_its_joint():
    told = options(axes={"offset_deg": 90})
    assert told.axes[0]["offset_rad"] == pytest.approx(math.pi / 2)
    assert told.axes[1]["centre_rad"] == pytest.approx(math.radians(20))  # −90° to 130°


def test_one_bus_is_one_resource_however_its_channel_is_written(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    from hil.can.channels import socket_path

    named = options(bus={"interface": "hil_unix", "channel": "can3"}).resource
    by_path = options(bus={"interface": "hil_unix", "channel": str(socket_path("can3"))}).resource
    assert named == by_path == "can://hil_unix/can3"
    assert options(bus=REAL).resource == "can://socketcan/can0"


def test_drives_on_one_bus_are_one_resource_because_it_has_one_sync():
    assert (
        options(nodes=[1, 2, 3, 4, 5, 6]).resource == options(nodes=[7, 8, 9, 10, 11, 12]).resource
    )


def test_a_log_of_the_bus_needs_a_folder_that_is_there(tmp_path):
    assert options(candump=str(tmp_path / "run.log")).candump == str(tmp_path / "run.log")
    error = refused(bus=BUS, candump=str(tmp_path / "none" / "run.log"))
    assert "candump" in error.message
    assert str(tmp_path / "none") in error.hint
    refused(bus=BUS, candump=str(tmp_path))


@pytest.mark.parametrize("channel", ["../can0", "/tmp/../can0.sock", "a/b", "a" * 200])
def test_a_channel_that_leads_elsewhere_is_refused(channel):
    assert "bus.channel" in refused(bus=BUS | {"channel": channel}).message


def test_a_log_that_is_there_is_kept(tmp_path):
    names = []
    for _ in range(3):
        log = BusLog(str(tmp_path / "run.log"), "can0")
        log(1.0, pack_frame(0x080, b""))
        log.close()
        names.append(log.path.name)
    assert names == ["run.log", "run-2.log", "run-3.log"]
    assert all((tmp_path / name).read_text("ascii").count("080#") == 1 for name in names)
