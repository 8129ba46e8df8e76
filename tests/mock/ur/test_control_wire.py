"""The unmodified `RTDEControlInterface` against the mock: what every method does to the arm.

Quantities are compared with the arm's published lengths (DH products made here) and with what
`RTDEReceiveInterface` says, not with the mock's own code.
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hil.arms import load_arm
from tests.support.mock_servers import mock_ur

rtde_control = pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")
rtde_receive = pytest.importorskip("rtde_receive", reason="ur-rtde has no wheel for this Python")

pytestmark = pytest.mark.wire

HOME = np.array([0.2, -1.4, 1.6, -1.7, -1.5, 0.1])
SPEED = 5.0
"""Device seconds per second."""
SAG_RAD = 5e-3
"""How far the real joints may be from their set-points at rest."""
NO_TOOL = (0.0, 0.0, 0.0, 0.0, 0.0, 1e-12)
"""Not quite zero: with zeros, ur-rtde sends a package of the wrong length (P6)."""


@dataclass
class Desk:
    """Both interfaces of one robot."""

    model: str
    where: str
    receive: Any
    control: Any

    def home(self):
        if not self.control.isProgramRunning():
            assert self.control.reuploadScript()
            self.until(self.control.isProgramRunning)
        assert self.control.moveJ(HOME.tolist(), 2.0, 10.0)

    def until(self, what, timeout_s=20.0):
        deadline = time.monotonic() + timeout_s
        while not what():
            assert time.monotonic() < deadline, "it never comes true"
            time.sleep(0.002)

    def standing(self):
        return not np.any(self.receive.getTargetQd())

    def pass_time(self, seconds):
        """Of the robot."""
        start = self.receive.getTimestamp()
        self.until(lambda: self.receive.getTimestamp() >= start + seconds)

    @property
    def q(self):
        """Set-points, after the receiving interface has caught up with the controlling one."""
        self.pass_time(0.05)
        return np.array(self.receive.getTargetQ())

    def pose(self, *change):
        """(6,) of the flange at home, with something added."""
        return pose_of(self.model, HOME) + np.array(change or [0.0] * 6)


def beside(*change):
    """Joint angles near `HOME`."""
    return HOME + np.array(change)


def pose_of(model, q, tool=NO_TOOL):
    """(6,) by the published Denavit–Hartenberg lengths."""
    at = np.eye(4)
    for (a, alpha, d, offset), angle in zip(load_arm(model).dh, q, strict=True):
        turn = Rotation.from_euler("ZX", [angle + offset, alpha]).as_matrix()
        c, s = np.cos(angle + offset), np.sin(angle + offset)
        at = at @ np.block([[turn, np.array([[a * c], [a * s], [d]])], [np.zeros((1, 3)), 1.0]])
    rotation = Rotation.from_matrix(at[:3, :3])
    point = at[:3, 3] + rotation.apply(tool[:3])
    return np.array([*point, *(rotation * Rotation.from_rotvec(tool[3:])).as_rotvec()])


def apart(pose, other):
    """Metres and radians between two poses."""
    turn = Rotation.from_rotvec(pose[3:]).inv() * Rotation.from_rotvec(other[3:])
    return np.linalg.norm(np.subtract(pose[:3], other[:3])), turn.magnitude()


@pytest.fixture(scope="module", params=["ur5", "ur5e"])
def desk(request):
    with mock_ur("--model", request.param, "--speed", f"{SPEED:g}") as mock:
        where = mock.address
        receive = rtde_receive.RTDEReceiveInterface(where)
        control = rtde_control.RTDEControlInterface(where)
        yield Desk(request.param, where, receive, control)
        control.stopScript()
        control.disconnect()
        receive.disconnect()


@pytest.fixture
def at_home(desk):
    desk.home()
    return desk


def test_a_joint_move_arrives_and_takes_its_time(at_home):
    target = HOME + 0.3
    start = at_home.receive.getTimestamp()
    assert at_home.control.moveJ(target.tolist(), 0.5, 1.0)
    # 0.3 rad at 0.5 rad/s and 1 rad/s²: 0.3 / 0.5 + 0.5 / 1 = 1.1 s.
    assert 1.0 < at_home.receive.getTimestamp() - start < 3.0
    np.testing.assert_allclose(at_home.q, target, atol=1e-6)
    at_home.pass_time(0.5)
    np.testing.assert_allclose(at_home.receive.getActualQ(), target, atol=SAG_RAD)


@pytest.mark.parametrize("by", ["moveL", "moveL_FK", "moveJ_IK"])
def test_moves_to_a_pose(at_home, by):
    control, target = at_home.control, at_home.pose()
    target[:3] += [0.03, -0.04, 0.08]
    given = target
    if by == "moveL_FK":
        given = control.getInverseKinematics(target.tolist())
    assert getattr(control, by)(list(given), 0.25, 1.0)
    metres, radians = apart(pose_of(at_home.model, at_home.q), target)
    assert metres < 1e-5
    assert radians < 1e-5


def test_a_path_of_joint_moves_with_blends(at_home):
    corner, end = beside(0.4, 0, 0, 0, 0, 0), beside(0.4, 0.3, 0, 0, 0, 0)
    path = [[*corner, 1.0, 2.0, 0.05], [*end, 1.0, 2.0, 0.0]]
    assert at_home.control.moveJ(path)
    np.testing.assert_allclose(at_home.q, end, atol=1e-5)


def test_a_path_of_linear_moves_tells_its_progress(at_home):
    start = at_home.pose()
    poses = [start + np.array([x, y, 0, 0, 0, 0]) for x, y in ((0, 0.1), (0.05, 0.1), (0.05, 0.0))]
    path = [[*pose, 0.05, 0.5, 0.01] for pose in poses[:-1]] + [[*poses[-1], 0.05, 0.5, 0.0]]
    assert at_home.control.moveL(path, True)
    seen = set()
    while (progress := at_home.control.getAsyncOperationProgress()) >= 0:
        seen.add(progress)
        time.sleep(0.001)
    assert seen == {0, 1, 2}
    metres, _ = apart(pose_of(at_home.model, at_home.q), poses[-1])
    assert metres < 1e-4


def test_a_path_of_mixed_moves(at_home):
    entry, kind = rtde_control.PathEntry, rtde_control.PathEntry.eMoveType
    path = rtde_control.Path()
    over = at_home.pose(0, 0, 0.05, 0, 0, 0)
    joints, tool = entry.PositionJoints, entry.PositionTcpPose
    path.addEntry(entry(kind.MoveJ, joints, [*(HOME + 0.1), 1.0, 2.0, 0.0]))
    path.addEntry(entry(kind.MoveL, tool, [*over, 0.2, 1.0, 0.0]))
    assert at_home.control.movePath(path, False)
    metres, _ = apart(pose_of(at_home.model, at_home.q), over)
    assert metres < 1e-4


def test_an_asynchronous_move_is_watched_and_stopped(at_home):
    target = beside(1.5, 0, 0, 0, 0, 0)
    assert at_home.control.moveJ(target.tolist(), 0.2, 1.0, True)
    status = at_home.control.getAsyncOperationProgressEx()
    assert status.isAsyncOperationRunning()
    at_home.pass_time(0.8)
    at_home.control.stopJ(2.0)
    at_home.until(at_home.standing)
    assert HOME[0] + 0.1 < at_home.q[0] < target[0] - 0.3
    assert at_home.control.getAsyncOperationProgress() < 0


def test_stop_in_tool_space(at_home):
    over = at_home.pose(0, 0.2, 0, 0, 0, 0)
    assert at_home.control.moveL(over.tolist(), 0.03, 0.5, True)
    at_home.pass_time(0.8)
    at_home.control.stopL(1.0)
    at_home.until(at_home.standing)
    metres, _ = apart(pose_of(at_home.model, at_home.q), over)
    assert 0.005 < metres < 0.195


def follow(desk, command, seconds):
    """Call `command` with the robot's time since the start, once per package that is seen."""
    start = last = desk.receive.getTimestamp()
    while (now := desk.receive.getTimestamp()) < start + seconds:
        if now > last:
            assert command(now - start)
            last = now
        time.sleep(1e-4)


def test_servoj_follows_and_stops(at_home):
    commanded = []

    def command(t):
        commanded.append(HOME + 0.2 * np.sin(t) * np.eye(6)[0])
        return at_home.control.servoJ(commanded[-1].tolist(), 0.0, 0.0, 0.008, 0.05, 500.0)

    follow(at_home, command, 1.5)
    at_home.pass_time(1.0)  # the thread goes on with the last one
    np.testing.assert_allclose(at_home.q, commanded[-1], atol=1e-4)
    assert at_home.control.servoStop()
    at_home.until(at_home.standing)
    np.testing.assert_allclose(at_home.q[1:], HOME[1:], atol=0.01)


def test_servol_goes_to_its_pose(at_home):
    target = at_home.pose(0, 0, 0.02, 0, 0, 0)
    follow(
        at_home,
        lambda t: at_home.control.servoL(target.tolist(), 0.0, 0.0, 0.008, 0.05, 500.0),
        2.0,
    )
    at_home.pass_time(1.0)
    metres, _ = apart(pose_of(at_home.model, at_home.q), target)
    assert metres < 1e-4
    assert at_home.control.servoStop()


def test_a_move_without_servo_stop_ends_the_program(at_home):
    assert at_home.control.servoJ(HOME.tolist(), 0.0, 0.0, 0.008, 0.1, 300.0)
    at_home.pass_time(0.1)
    assert not at_home.control.moveJ(HOME.tolist(), 1.0, 1.0)
    assert not at_home.control.isProgramRunning()


def test_speedj_goes_on_until_it_is_stopped(at_home):
    wanted = [0.2, -0.1, 0.1, 0.0, 0.1, -0.2]
    assert at_home.control.speedJ(wanted, 2.0, 0.1)
    at_home.pass_time(0.5)
    np.testing.assert_allclose(at_home.receive.getTargetQd(), wanted, atol=1e-6)
    assert at_home.control.speedStop(2.0)
    at_home.until(at_home.standing)


def test_speedl_moves_the_tool_straight(at_home):
    start = at_home.pose()
    assert at_home.control.speedL([0, 0, 0.05, 0, 0, 0], 0.5)
    at_home.pass_time(1.0)
    assert at_home.control.speedStop(1.0)
    at_home.until(at_home.standing)
    moved = pose_of(at_home.model, at_home.q) - start
    assert 0.03 < moved[2] < 0.2
    assert np.linalg.norm(moved[:2]) < 1e-3


def test_jogging(at_home):
    control = at_home.control
    start = at_home.pose()
    assert control.jogStart([0, 0.05, 0, 0, 0, 0], control.FEATURE_BASE)
    at_home.pass_time(1.0)
    assert control.jogStop()
    at_home.until(at_home.standing)
    moved = pose_of(at_home.model, at_home.q) - start
    assert 0.02 < moved[1] < 0.2
    assert np.hypot(moved[0], moved[2]) < 1e-3


def test_payload_is_read_back_by_rtde(at_home):
    assert at_home.control.setPayload(1.5, [0.01, -0.02, 0.05])
    at_home.pass_time(0.05)
    assert at_home.receive.getPayload() == pytest.approx(1.5)
    assert at_home.receive.getPayloadCog() == pytest.approx([0.01, -0.02, 0.05])
    assert at_home.control.setPayload(0.5, [0, 0, 0])
    at_home.pass_time(0.05)
    kept = [0.01, -0.02, 0.05] if at_home.model == "ur5e" else [0, 0, 0]
    assert at_home.receive.getPayloadCog() == pytest.approx(kept)


def test_a_target_payload_is_true_but_nothing_on_cb3(at_home):
    assert at_home.control.setPayload(1.0, [0, 0, 0.03])
    inertia = [0.01, 0.02, 0.02, 0.0, 0.0, 0.0]
    assert at_home.control.setTargetPayload(2.0, [0, 0, 0.06], inertia)
    at_home.pass_time(0.05)
    expected = 2.0 if at_home.model == "ur5e" else 1.0
    assert at_home.receive.getPayload() == pytest.approx(expected)
    if at_home.model == "ur5e":
        assert at_home.receive.getPayloadInertia() == pytest.approx(inertia)


def test_tool_centre_point_and_kinematics(at_home):
    control, tool = at_home.control, np.array([0.01, 0.02, 0.1, 0.2, -0.1, 0.3])
    at_home.pass_time(0.5)
    assert control.setTcp(tool.tolist())
    assert control.getTCPOffset() == pytest.approx(tool)
    expected = pose_of(at_home.model, HOME, tool)
    for found, metres_most in (
        (control.getForwardKinematics(HOME.tolist(), tool.tolist()), 1e-9),
        (control.getForwardKinematics(), 2e-3),  # where the real joints are
    ):
        metres, radians = apart(found, expected)
        assert metres < metres_most
        assert radians < max(1e-7, 2 * metres_most)
    near = (HOME + 0.05).tolist()
    assert control.getInverseKinematics(expected.tolist()) == pytest.approx(HOME, abs=1e-6)
    found = control.getInverseKinematics(expected.tolist(), near)
    assert found == pytest.approx(HOME, abs=1e-6)
    assert control.getInverseKinematicsHasSolution(expected.tolist())
    assert not control.getInverseKinematicsHasSolution([3.0, 0, 0, 0, 0, 0])
    flange = control.poseTrans(at_home.pose().tolist(), tool.tolist())
    assert apart(flange, expected)[0] < 1e-9
    assert control.setTcp([0.0] * 6)


def test_a_pose_out_of_reach_ends_the_program(at_home):
    assert at_home.control.getInverseKinematics([3.0, 0, 0, 0, 0, 0]) == []
    assert not at_home.control.isProgramRunning()


def test_limits_steadiness_and_torques(at_home):
    control = at_home.control
    at_home.pass_time(0.5)
    assert control.isSteady()
    assert control.isJointsWithinSafetyLimits(HOME.tolist())
    assert not control.isJointsWithinSafetyLimits([7.0, 0, 0, 0, 0, 0])
    assert control.isPoseWithinSafetyLimits(at_home.pose().tolist())
    assert not control.isPoseWithinSafetyLimits([3.0, 0, 0, 0, 0, 0])
    control.getJointTorques()
    at_home.pass_time(0.1)  # the first answer is what was in the registers (P2)
    measured = control.getJointTorques()
    # Nothing pushes: what is left is friction the model does not know, and errors of its masses.
    assert np.abs(measured).max() < 25.0
    flange = control.getActualToolFlangePose()
    at_home.pass_time(0.1)
    flange = control.getActualToolFlangePose()
    assert apart(flange, at_home.pose())[0] < 5e-3


def test_what_cb3_does_not_know_returns_stale_registers(at_home):
    control = at_home.control
    control.poseTrans([0.125, 0, 0, 0, 0, 0], [0.0] * 6)
    control.getStepTime()
    at_home.pass_time(0.1)
    tick = 0.002 if at_home.model == "ur5e" else 0.125
    assert control.getStepTime() == pytest.approx(tick)


def test_history_and_waypoint(at_home):
    if at_home.model == "ur5":
        pytest.skip("e-Series only")
    control = at_home.control
    assert control.getTargetWaypoint() == pytest.approx(pose_of("ur5e", HOME), abs=1e-6)
    control.getActualJointPositionsHistory(10)
    at_home.pass_time(0.1)
    assert control.getActualJointPositionsHistory(10) == pytest.approx(HOME, abs=SAG_RAD)


@pytest.mark.parametrize(
    ("method", "arguments"),
    [
        ("zeroFtSensor", ()),
        ("forceModeSetDamping", (0.1,)),
        ("forceModeSetGainScaling", (0.5,)),
        ("setGravity", ([0.0, 0.0, 9.82],)),
        ("ftRtdeInputEnable", (True, 0.1, [0.0] * 3, [0.0] * 3)),
        ("enableExternalFtSensor", (False,)),
        ("forceMode", ([0.0] * 6, [0, 0, 1, 0, 0, 0], [0, 0, -5, 0, 0, 0], 2, [0.1] * 6)),
        ("forceModeStop", ()),
        ("teachMode", ()),
        ("endTeachMode", ()),
        ("freedriveMode", ()),
        ("endFreedriveMode", ()),
        ("startContactDetection", ([0.0, 0.0, -1.0, 0, 0, 0],)),
        ("stopContactDetection", ()),
        ("kickWatchdog", ()),
    ],
)
def test_methods_that_are_accepted(at_home, method, arguments):
    if method == "startContactDetection" and at_home.model == "ur5":
        pytest.skip("CB3 sees a contact at once: the script lacks the lines")
    answer = getattr(at_home.control, method)(*arguments)
    assert answer is True or method == "stopContactDetection"
    assert at_home.control.isProgramRunning()
    ends = {"teachMode": "endTeachMode", "freedriveMode": "endFreedriveMode"}
    if method in ends:
        assert getattr(at_home.control, ends[method])()
    if method == "forceMode":
        assert at_home.control.forceModeStop()
    if method == "startContactDetection":
        assert not at_home.control.readContactDetection()
        at_home.control.stopContactDetection()


def test_the_watchdog_stops_a_program_that_nobody_speaks_to(at_home):
    control = at_home.control
    assert control.setWatchdog(0.3)
    for _ in range(20):
        assert control.kickWatchdog()
        time.sleep(0.3 / SPEED)
        assert control.isProgramRunning()
    at_home.pass_time(4.0)
    assert not control.isProgramRunning()
    assert not control.moveJ(HOME.tolist(), 1.0, 1.0)


def test_a_custom_function_runs_and_the_control_script_comes_back(at_home):
    target = ",".join(f"{q:.6f}" for q in HOME + 0.1)
    body = f"movej([{target}], a=5, v=1)\nsleep(0.1)\nset_digital_out(3, True)\n"
    assert at_home.control.sendCustomScriptFunction("mine", body)
    np.testing.assert_allclose(at_home.q, HOME + 0.1, atol=1e-5)
    at_home.until(lambda: at_home.receive.getActualDigitalOutputBits() & 8)
    assert at_home.control.isProgramRunning()
    assert at_home.control.isSteady() in (True, False)


def test_stop_script_and_reupload(at_home):
    control = at_home.control
    control.stopScript()
    assert not control.isProgramRunning()
    at_home.until(lambda: at_home.receive.getRuntimeState() == 1)
    assert not control.setPayload(1.0, [0, 0, 0])
    assert control.reuploadScript()
    at_home.until(control.isProgramRunning)
    assert control.moveJ(HOME.tolist(), 1.0, 1.0)


def test_a_protective_stop_by_program(desk):
    with mock_ur("--model", desk.model, "--speed", f"{SPEED:g}") as mock:
        where = mock.address
        receive = rtde_receive.RTDEReceiveInterface(where)
        control = rtde_control.RTDEControlInterface(where)
        try:
            assert not control.triggerProtectiveStop()  # its answer never comes
            Desk(desk.model, where, receive, control).until(receive.isProtectiveStopped)
            assert not control.moveJ(HOME.tolist(), 1.0, 1.0)
        finally:
            control.disconnect()
            receive.disconnect()
