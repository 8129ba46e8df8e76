"""Set-points row by row, braking on the way, control by torque: without drives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hil.core.errors import CommandRefused
from hil_drivers.cia402.bus import Inputs, Outputs
from hil_drivers.cia402.gains import Gains
from hil_drivers.cia402.player import FADE_S, HOLDING, MOVING, Player
from hil_drivers.cia402.track import Track
from tests.support.cia402_parts import CSP, CST, PERIOD_S

CSV = 9
N = 2
RAD = 1e-6
WRAP = 1 << 32


def track(position: object, segment: int = 5, torque: object = 0, holding: object = None) -> Track:
    """A motion of two axes from the positions of the first; the second goes half as far."""
    first = np.asarray(position, dtype=np.int64)
    both = np.stack((first, first // 2), axis=1)
    both = (both + WRAP // 2) % WRAP - WRAP // 2
    velocity = np.gradient(both, axis=0) / PERIOD_S if len(both) > 1 else np.zeros_like(both)
    torques, held = (
        np.broadcast_to(np.asarray(each), both.shape).astype(np.int64)
        for each in (torque, torque if holding is None else holding)
    )
    return Track(segment, both, velocity.astype(np.int64), torques, held)


class Play:
    """A player, engaged, and what it has written."""

    def __init__(self, mode: int = CSP, start: int = 0, **options: object) -> None:
        self.outputs, self.inputs = Outputs.idle(N), Inputs.none_yet(N)
        self.outputs.target_position[:] = [start, start // 2]
        self.inputs.position[:] = [start, start // 2]
        self.player = Player(PERIOD_S, [RAD, -RAD], **options)  # type: ignore[arg-type]
        self.player.engage(mode, self.outputs)

    def steps(self, count: int) -> list[int]:
        """Target positions of the first axis."""
        return [self.step().target_position[0] for _ in range(count)]

    def step(self) -> Outputs:
        self.player.step(self.inputs, self.outputs)
        return self.outputs

    def begin(self, motion: Track) -> None:
        self.player.load(motion)
        self.player.start()

    def to_rest(self, most: int = 5000) -> list[int]:
        """Target positions of the first axis until it holds."""
        said = []
        while self.player.moving:
            said.append(self.step().target_position[0])
            assert len(said) < most
        return said


def test_engaged_player_holds_the_preloaded_targets() -> None:
    play = Play(start=1000)
    assert play.steps(3) == [1000] * 3
    assert play.outputs.target_position[1] == 500
    assert play.outputs.status == HOLDING


def test_rows_are_played_one_a_cycle_and_the_last_one_is_held() -> None:
    play = Play()
    play.begin(track([0, 1, 3, 6, 8, 9]))
    assert play.steps(8) == [0, 1, 3, 6, 8, 9, 9, 9]


def test_segment_and_status_go_with_the_row_and_the_last_row_is_holding() -> None:
    play = Play()
    play.begin(track([0, 10, 20], segment=5))
    said = [(out.segment, out.status) for out in (play.step() for _ in range(1))]
    for _ in range(3):
        out = play.step()
        said.append((out.segment, out.status))
    assert said == [(5, MOVING), (5, MOVING), (5, HOLDING), (5, HOLDING)]


def test_hold_of_one_row_announces_its_segment() -> None:
    play = Play()
    play.begin(track([0], segment=9))
    out = play.step()
    assert (out.segment, out.status) == (9, HOLDING)
    assert not play.player.moving


def test_motion_begins_where_the_last_one_ended() -> None:
    play = Play()
    play.begin(track([0, 50, 100]))
    play.steps(3)
    play.begin(track([100, 50]))
    assert play.steps(2) == [100, 50]


def test_motion_that_begins_elsewhere_is_refused_with_axis_and_distance() -> None:
    play = Play()
    play.player.load(track([5000, 6000]))
    with pytest.raises(
        CommandRefused, match=r"begins 0\.0050 rad from the held position of axis 1"
    ):
        play.player.start()


def test_start_without_motion_is_refused() -> None:
    with pytest.raises(CommandRefused, match="no segment is prepared"):
        Play().player.start()


def test_start_while_moving_is_refused() -> None:
    play = Play()
    play.begin(track([0, 1, 2, 3]))
    play.step()
    play.player.load(track([0, 1]))
    with pytest.raises(CommandRefused, match="still running"):
        play.player.start()


def test_start_before_the_drives_are_enabled_is_refused() -> None:
    player = Player(PERIOD_S, [RAD, RAD])
    player.load(track([0, 1]))
    with pytest.raises(CommandRefused, match="not enabled"):
        player.start()


def test_motion_of_another_arm_is_refused() -> None:
    with pytest.raises(CommandRefused, match="2 axes, the arm 3"):
        Player(PERIOD_S, [RAD] * 3).load(track([0, 1]))


def test_stop_brakes_on_the_way_with_the_deceleration_of_the_fastest_joint() -> None:
    """1 rad/s in steps of 4 mrad, at 2 rad/s²: 0.5 s, 125 cycles, 0.25 rad."""
    play = Play()
    play.begin(track(np.arange(2000) * 4000))
    play.steps(101)
    play.player.stop(2.0)
    way = play.to_rest()
    assert len(way) == pytest.approx(125, abs=2)
    assert way[-1] - 400_000 == pytest.approx(250_000, rel=0.02)
    decelerations = -np.diff([400_000, *way], n=2) * RAD / PERIOD_S**2
    assert np.max(decelerations) < 2.2


def test_braking_axes_stay_on_the_planned_way() -> None:
    play = Play()
    way = (1e5 * (1 - np.cos(np.arange(500) * 0.02))).astype(np.int64)
    play.begin(track(way))
    play.steps(200)
    play.player.stop(0.5)
    while play.player.moving:
        first, second = play.step().target_position
        assert second == pytest.approx(first / 2, abs=1)


def test_stop_that_is_said_twice_prolongs_nothing() -> None:
    once, twice = Play(), Play()
    for play in (once, twice):
        play.begin(track(np.arange(2000) * 4000))
        play.steps(101)
        play.player.stop(2.0)
    twice.steps(20)
    twice.player.stop(2.0)
    once.steps(20)
    assert once.to_rest() == twice.to_rest()


def test_stop_at_the_end_does_not_run_past_it() -> None:
    play = Play()
    play.begin(track(np.arange(20) * 4000))
    play.steps(18)
    play.player.stop(0.1)
    assert play.to_rest()[-1] == 19 * 4000


def test_stopped_arm_can_start_again_from_where_it_stands() -> None:
    play = Play()
    play.begin(track(np.arange(2000) * 4000))
    play.steps(101)
    play.player.stop(2.0)
    at = play.to_rest()[-1]
    play.begin(track([at, at + 100]))
    assert play.steps(2) == [at, at + 100]


def test_stop_forgets_what_was_loaded_and_what_was_about_to_begin() -> None:
    play = Play()
    play.begin(track([0, 1, 2]))
    play.player.stop(1.0)
    assert play.steps(3) == [0, 0, 0]
    assert not play.player.moving
    with pytest.raises(CommandRefused):
        play.player.start()


def test_stop_of_an_arm_at_rest_does_nothing() -> None:
    play = Play(start=70)
    play.player.stop(1.0)
    assert play.steps(2) == [70, 70]


def test_positions_may_wrap_on_the_way() -> None:
    """A counter of 32 bits that runs over goes on at the other end, also while braking."""
    top = (1 << 31) - 6000
    play = Play(start=top)
    play.player.engage(CSP, play.outputs)
    motion = track(top + np.arange(2000) * 4000)
    motion = replace(motion, position=np.repeat(motion.position[:, :1], 2, axis=1))
    play.outputs.target_position[:] = [top, top]
    play.player.engage(CSP, play.outputs)
    play.begin(motion)
    play.steps(3)
    play.player.stop(50.0)
    way = play.to_rest()
    assert all(-(1 << 31) <= p < 1 << 31 for p in way)
    assert way[-1] < 0


@pytest.mark.parametrize("mode", [CSV, CST])
def test_led_by_velocity_or_torque_the_commanded_position_is_told_too(mode: int) -> None:
    gains = Gains((0.0, 0.0), (0.0, 0.0), (100.0, 100.0), (0.0, 0.0))
    play = Play(mode, gains=gains)
    play.outputs.mode[:] = [mode] * N
    play.begin(track([0, 10, 20, 30]))
    assert play.steps(3) == [0, 10, 20]
    play.outputs.mode[:] = [CSP] * N  # switching: what the supervisor preloads is left alone
    play.outputs.target_position[:] = [77, 77]
    assert play.steps(1) == [77]


def test_disengaged_player_has_no_motion_and_no_segment() -> None:
    play = Play()
    play.begin(track([0, 1, 2, 3]))
    play.step()
    play.player.disengage()
    assert not play.player.moving
    assert (play.player.segment, play.player.status) == (-1, 0)


def test_feed_forward_goes_as_torque_offset_only_when_asked_for() -> None:
    plain, forward = Play(), Play(feed_forward=True)
    for play in (plain, forward):
        play.begin(track(np.zeros(300), torque=200))
        for _ in range(300):
            play.step()
    assert plain.outputs.torque_offset == [0, 0]
    assert forward.outputs.torque_offset == [200, 200]


def test_feed_forward_begins_without_a_step() -> None:
    play = Play(feed_forward=True)
    play.begin(track(np.zeros(300), torque=200))
    said = [play.step().torque_offset[0] for _ in range(300)]
    assert said[0] <= 2
    assert max(np.diff(said)) <= 3
    assert said.index(200) * PERIOD_S == pytest.approx(FADE_S, rel=0.05)


def test_torque_that_moves_the_arm_goes_as_it_brakes_and_what_holds_it_stays() -> None:
    play = Play(feed_forward=True)
    play.begin(track(np.arange(2000) * 4000, torque=200, holding=50))
    play.steps(200)
    play.player.stop(2.0)
    braked = []
    while play.player.moving:
        braked.append(play.step().torque_offset[0])
    assert np.max(np.abs(np.diff([200, *braked]))) <= 3
    assert np.max(np.diff(braked)) <= 0
    assert [play.step().torque_offset[0] for _ in range(3)] == [50] * 3


def test_a_motion_that_ends_with_an_acceleration_is_held_without_its_torque() -> None:
    play = Play(feed_forward=True)
    play.begin(track(np.arange(300), torque=200, holding=50))
    play.steps(300)
    said = [play.step().torque_offset[0] for _ in range(round(FADE_S / PERIOD_S) + 1)]
    assert np.max(np.abs(np.diff([200, *said]))) <= 3
    assert said[-1] == 50


GAINS = Gains(kp=(0.1, 0.1), kd=(0.01, 0.01), limit=(300.0, 300.0), kv=(2.0, 2.0))


def test_torque_mode_commands_feed_forward_and_position_control() -> None:
    play = Play(CST, start=1000, gains=GAINS)
    play.player.engage(CST, play.outputs)
    play.player.position = [1000, 500]
    play.inputs.position[:] = [900, 500]
    play.inputs.velocity[:] = [-200, 0]
    assert play.step().target_torque == [12, 0]


def test_torque_is_limited() -> None:
    play = Play(CST, gains=GAINS)
    play.inputs.position[:] = [-100_000, 100_000]
    assert play.step().target_torque == [300, -300]


def test_torque_mode_begins_with_the_torque_that_held_the_arm() -> None:
    play = Play(CSP, start=1000, gains=GAINS)
    play.outputs.target_torque[:] = [77, -5]
    play.player.engage(CST, play.outputs)
    assert play.step().target_torque == [77, -5]
    assert play.player.position == [1000, 500]


def test_velocity_mode_holds_its_position() -> None:
    play = Play(CSV, start=1000, gains=GAINS)
    play.inputs.position[:] = [990, 500]
    assert play.step().target_velocity == [20, 0]


def test_velocity_mode_sends_the_velocity_of_the_way_and_none_at_its_end() -> None:
    play = Play(CSV, gains=GAINS)
    play.begin(track(np.arange(4) * 400))
    said = []
    for _ in range(4):
        play.step()
        play.inputs.position[:] = play.player.position
        said.append(play.player.velocity[0])
    assert said == [100_000, 100_000, 100_000, 0]


def test_what_is_measured_is_compared_with_the_set_point_that_it_can_show() -> None:
    """An axis that follows exactly, shown three cycles late, is not corrected."""
    play = Play(CSV, gains=GAINS)
    play.begin(track(np.arange(10) * 400))
    way: list[list[int]] = [[0, 0]] * 3
    for _ in range(9):
        play.inputs.position[:] = way[-3]
        assert play.step().target_velocity[0] == play.player.velocity[0]
        way.append(play.player.position)
