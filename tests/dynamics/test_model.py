"""Rigid dynamics: the model, base parameters, coupled drives, momentum, friction, documents."""

import json
import subprocess
import sys

import numpy as np
import pytest

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.core.errors import DataError, FitError, SpecError
from hil.dynamics import (
    BaseParameters,
    RobotModel,
    base_parameters,
    conditioning,
    friction_terms,
    joint_columns,
    load_model,
    payload_parameters,
)
from tests.support.dynamics_arms import (
    UR_ARMS,
    dh_chain,
    mjcf,
    motion,
    mujoco_torques,
    urdf,
    written,
)

# Robot models against independent sources: MuJoCo, the textbook DH chain, published numbers


ROTORS = (0.75, 0.74, 0.62, 0.11, 0.12, 0.13)
LOAD = Payload(2.8, (0.03, -0.15, 0.06), (0.011, 0.014, 0.009, 0.001, -0.002, 0.0005))


@pytest.mark.parametrize("name", ["ur5", "ur10e"])
def test_inverse_dynamics_equals_mujoco(name):
    mujoco = pytest.importorskip("mujoco")
    q, qd, qdd = motion(50)
    peer = mujoco.MjModel.from_xml_string(mjcf(name, ROTORS))
    ours = RobotModel.from_arm(name, ROTORS).inverse_dynamics(q, qd, qdd)
    np.testing.assert_allclose(ours, mujoco_torques(peer, q, qd, qdd), atol=1e-9)


@pytest.mark.parametrize("name", ["ur3", "ur5e"])
def test_mass_matrix_equals_mujoco(name):
    mujoco = pytest.importorskip("mujoco")
    peer = mujoco.MjModel.from_xml_string(mjcf(name, ROTORS))
    data, q = mujoco.MjData(peer), motion(10)[0]
    for sample, ours in zip(q, RobotModel.from_arm(name, ROTORS).mass_matrix(q), strict=True):
        data.qpos[:] = sample
        mujoco.mj_forward(peer, data)
        theirs = np.zeros((6, 6))
        mujoco.mj_fullM(peer, data, theirs)
        np.testing.assert_allclose(ours, theirs, atol=1e-10)


@pytest.mark.parametrize("name", ["ur5", "ur10"])
def test_payload_adds_what_a_mujoco_body_adds(name):
    mujoco = pytest.importorskip("mujoco")
    q, qd, qdd = motion(30)
    bare = mujoco_torques(mujoco.MjModel.from_xml_string(mjcf(name)), q, qd, qdd)
    loaded = mujoco.MjModel.from_xml_string(mjcf(name, payload=LOAD))
    added = RobotModel.from_arm(name).payload_effort(LOAD, q, qd, qdd)
    np.testing.assert_allclose(added, mujoco_torques(loaded, q, qd, qdd) - bare, atol=1e-9)


@pytest.mark.parametrize("name", [*UR_ARMS, "lab6"])
def test_flange_pose_equals_the_textbook_dh_chain(name):
    q = motion(20)[0]
    expected = [dh_chain(name, sample)[-1] for sample in q]
    np.testing.assert_allclose(RobotModel.from_arm(name).flange_pose(q), expected, atol=1e-12)


def test_ur5_flange_at_zero_is_where_the_published_dimensions_put_it():
    # Stretched out along −x: a2 + a3 behind, d4 + d6 to the side, d1 − d5 above the base.
    pose = RobotModel.from_arm("ur5").flange_pose(np.zeros((1, 6)))[0]
    np.testing.assert_allclose(pose[:3, 3], [-0.81725, -0.19145, -0.005491], atol=1e-9)


def test_gravity_of_a_tilted_base_turns_with_it():
    q = motion(5)[0]
    upright, hanging = RobotModel.from_arm("ur5"), RobotModel.from_arm("ur5", gravity=(0, 0, 9.81))
    np.testing.assert_allclose(hanging.gravity(q), -upright.gravity(q), atol=1e-12)
    on_a_wall = RobotModel.from_arm("ur5", gravity=(-9.81, 0, 0)).gravity(q)
    assert np.abs(on_a_wall[:, 0]).max() > 1.0
    assert np.abs(upright.gravity(q)[:, 0]).max() < 1e-9


@pytest.mark.parametrize("rotors", [None, ROTORS])
@pytest.mark.parametrize("name", ["ur5", "lab6"])
def test_regressor_times_parameters_is_inverse_dynamics(name, rotors):
    model = RobotModel.from_arm(name, rotors)
    q, qd, qdd = motion(40)
    torque = model.inverse_dynamics(q, qd, qdd).ravel()
    np.testing.assert_allclose(model.regressor(q, qd, qdd) @ model.parameters(), torque, atol=1e-9)


def test_regressor_rows_are_sample_major():
    model = RobotModel.from_arm("ur5")
    q, qd, qdd = motion(3)
    whole = model.regressor(q, qd, qdd)
    last = model.regressor(q[2:], qd[2:], qdd[2:])
    assert whole.shape == (18, 66)
    np.testing.assert_array_equal(whole[12:], last)
    np.testing.assert_array_equal(whole[12:, 60:], np.diag(qdd[2]))


def test_gravity_regressor_times_parameters_is_gravity():
    model = RobotModel.from_arm("ur10e")
    q = motion(20)[0]
    columns = model.gravity_regressor(q)
    torque = columns @ model.parameters(rotor=False)
    np.testing.assert_allclose(torque, model.gravity(q).ravel(), atol=1e-9)
    inertias = [i for i, name in enumerate(model.parameter_names(rotor=False)) if "I" in name]
    assert np.abs(columns[:, inertias]).max() < 1e-12


def test_payload_regressor_times_its_ten_parameters_is_the_payload_effort():
    model = RobotModel.from_arm("ur5e")
    q, qd, qdd = motion(20)
    effort = model.payload_effort(LOAD, q, qd, qdd)
    predicted = model.payload_regressor(q, qd, qdd) @ payload_parameters(LOAD)
    np.testing.assert_allclose(predicted, effort.ravel(), atol=1e-9)


def test_payload_held_level_acts_with_its_lever_arm():
    # At zero the UR5 is stretched out level, its flange a2 + a3 away from joint 2.
    load = Payload(mass=1.5)
    q = np.zeros((1, 6))
    still = np.zeros((1, 6))
    effort = RobotModel.from_arm("ur5").payload_effort(load, q, still, still)
    assert effort[0, 1] == pytest.approx(-1.5 * 9.81 * 0.81725, rel=1e-9)


def test_parameter_names_match_the_columns():
    model = RobotModel.from_arm("ur5", ROTORS)
    named = dict(zip(model.parameter_names(), model.parameters(), strict=True))
    assert named["m_2"] == pytest.approx(8.393)
    assert named["Ia_3"] == pytest.approx(0.62)
    assert len(model.parameter_names(rotor=False)) == 60


def test_an_empty_payload_changes_nothing():
    model = RobotModel.from_arm("ur5")
    assert model.with_payload(Payload()) is model


def test_limits_come_from_the_arm():
    model = load_model("ur10")
    assert model.n == 6
    assert model.joint_names[1] == "shoulder_lift_joint"
    np.testing.assert_allclose(model.effort_max, [330, 330, 150, 56, 56, 56])
    np.testing.assert_allclose(np.degrees(model.qd_max), [120, 120, 180, 180, 180, 180])
    np.testing.assert_allclose(np.degrees(model.q_min), -360)


def test_unknown_arm_is_refused_with_the_known_names():
    with pytest.raises(SpecError, match="ur7") as caught:
        load_model("ur7")
    assert "ur10e" in caught.value.hint


def test_wrong_number_of_rotor_inertias_is_refused():
    with pytest.raises(SpecError, match="3 rotor inertias were passed for the 6 joints"):
        RobotModel.from_arm("ur5", [1, 2, 3])


def test_data_of_another_arm_are_refused():
    with pytest.raises(DataError, match="6 joints per row"):
        RobotModel.from_arm("ur5").gravity(np.zeros((4, 7)))


def test_importing_hil_does_not_load_pinocchio():
    code = (
        "import sys, hil, hil.dynamics, hil.dynamics.collision;"
        "sys.exit('pinocchio' in sys.modules or 'mujoco' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# Base parameters: published ranks, equal predictions, stability against the samples


@pytest.mark.parametrize("name", UR_ARMS)
def test_ur_arms_have_36_base_parameters_and_40_with_rotor_inertias(name):
    # 36: e.g. Gaz et al. 2014 for arms of this build; 40 with rotors: Mamedov and Mikhel 2020.
    model = RobotModel.from_arm(name)
    assert base_parameters(model, rotor=False).rank == 36
    assert base_parameters(model, rotor=True).rank == 40


def test_gravity_sees_two_first_moments_of_every_link_but_the_first():
    base = base_parameters(RobotModel.from_arm("ur5"), gravity_only=True)
    assert [name.split()[0] for name in base.names] == [
        f"{moment}_{link}" for link in range(2, 7) for moment in ("mx", "my")
    ]


@pytest.mark.parametrize("gravity_only", [True, False])
def test_base_parameters_predict_the_same_torque_elsewhere(gravity_only):
    model = RobotModel.from_arm("ur10e", [0.7, 3.7, 0.5, 0.1, 0.2, 0.4])
    base = base_parameters(model, gravity_only=gravity_only)
    q, qd, qdd = motion(30, seed=99)
    if gravity_only:
        W, full, torque = (
            model.gravity_regressor(q),
            model.parameters(rotor=False),
            model.gravity(q),
        )
    else:
        W, full = model.regressor(q, qd, qdd), model.parameters()
        torque = model.inverse_dynamics(q, qd, qdd)
    reduced = base.reduce(W) @ base.combine(full)
    np.testing.assert_allclose(reduced, torque.ravel(), atol=1e-9)
    np.testing.assert_allclose(W @ base.expand(base.combine(full)), torque.ravel(), atol=1e-9)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_samples_do_not_decide_what_is_a_base_parameter(seed):
    model = RobotModel.from_arm("ur5")
    first, other = base_parameters(model, seed=0), base_parameters(model, seed=seed)
    assert first.names == other.names
    np.testing.assert_array_equal(first.independent, other.independent)
    np.testing.assert_array_equal(first.combination, other.combination)


def test_names_say_what_is_lumped_together():
    names = base_parameters(RobotModel.from_arm("ur5"), rotor=False).names
    assert "mx_3 - 0.39225 m_4 - 0.39225 m_5 - 0.39225 m_6" in names
    assert "Izz_6" in names


def test_columns_of_another_scale_count_as_much():
    random = np.random.default_rng(0)
    W = random.normal(size=(50, 4)) * [1e6, 1.0, 1e-3, 1.0]
    W[:, 3] = W[:, 1] - 2e3 * W[:, 2]
    base = BaseParameters.from_regressor(W, ("a", "b", "c", "d"))
    assert base.names == ("a", "b + d", "c - 2000 d")


@pytest.mark.parametrize(
    ("W", "message"),
    [
        (np.ones((2, 3)), "cannot determine 3 parameters"),
        (np.full((5, 3), np.nan), "NaN"),
        (np.zeros((5, 3)), "zeros"),
    ],
)
def test_a_useless_regressor_is_refused(W, message):
    with pytest.raises(FitError, match=message):
        BaseParameters.from_regressor(W, ("a", "b", "c"))


def test_conditioning_is_that_of_the_singular_values():
    W = np.random.default_rng(1).normal(size=(200, 5)) * [1, 10, 100, 1, 1]
    numbers = conditioning(W)
    singular = np.linalg.svd(W, compute_uv=False)
    assert numbers.raw == pytest.approx(singular[0] / singular[-1])
    scaled = np.linalg.svd(W / np.linalg.norm(W, axis=0), compute_uv=False)
    assert numbers.scaled == pytest.approx(scaled[0] / scaled[-1])
    assert numbers.scaled < numbers.raw
    assert conditioning(np.hstack([W, 0 * W[:, :1]])).raw == np.inf


# An arm in its motors' coordinates: the joints' energy, and rotors that stay the motors'


COUPLED_ROTORS = np.array([0.36, 0.36, 0.1, 0.03, 0.05, 0.01])
LIGHT_LOAD = Payload(1.5, (0.02, -0.01, 0.05))


def joints(motors):
    """By hand: motor 6 counts q5 + q6."""
    out = np.array(motors)
    out[:, 5] -= out[:, 4]
    return out


@pytest.fixture(scope="module")
def robots():
    return load_model("tx40@motors", COUPLED_ROTORS), load_model("tx40")


@pytest.mark.parametrize("loaded", [False, True], ids=["bare", "loaded"])
@pytest.mark.parametrize("samples", [400, 4000], ids=["few", "many"])
def test_power_of_the_motors_is_the_change_of_energy(robots, loaded, samples) -> None:
    coupled, serial = (one.with_payload(LIGHT_LOAD) if loaded else one for one in robots)
    t, dt = np.linspace(0.0, samples * 5e-4, samples, retstep=True)
    phase = np.arange(1, 7)
    s, sd = np.sin(np.outer(t, phase)), phase * np.cos(np.outer(t, phase))
    sdd = -(phase**2) * s
    q, qd = joints(s), joints(sd)
    M = serial.mass_matrix(q)
    kinetic = 0.5 * np.einsum("ti,tij,tj->t", qd, M, qd) + 0.5 * sd**2 @ COUPLED_ROTORS
    # Gravity's power in the joints, for the potential energy is not to be had.
    gained = np.gradient(kinetic, dt) + np.sum(serial.gravity(q) * qd, axis=1)
    power = np.sum(coupled.inverse_dynamics(s, sd, sdd) * sd, axis=1)
    np.testing.assert_allclose(power[2:-2], gained[2:-2], atol=2e-4 * np.abs(gained).max())


def test_regressor_times_parameters_is_the_torque(robots) -> None:
    coupled, _ = robots
    s, sd, sdd = motion(30)
    torque = coupled.regressor(s, sd, sdd) @ coupled.parameters()
    np.testing.assert_allclose(torque, coupled.inverse_dynamics(s, sd, sdd).ravel(), atol=1e-10)
    some = np.array([3, 44, 61, 65])
    np.testing.assert_allclose(
        coupled.regressor(s, sd, sdd, columns=some), coupled.regressor(s, sd, sdd)[:, some]
    )


def test_derivatives_are_those_of_finite_differences(robots) -> None:
    coupled, _ = robots
    at = motion(3)
    for found, which in zip(coupled.inverse_dynamics_derivatives(*at), range(3), strict=True):
        for j in range(6):
            up, down = ([x.copy() for x in at] for _ in range(2))
            up[which][:, j] += 1e-6
            down[which][:, j] -= 1e-6
            slope = (coupled.inverse_dynamics(*up) - coupled.inverse_dynamics(*down)) / 2e-6
            np.testing.assert_allclose(found[:, :, j], slope, atol=1e-6)


def test_inertia_is_positive_and_symmetric_with_the_rotors_on_the_diagonal(robots) -> None:
    coupled, _ = robots
    bare = load_model("tx40@motors")
    s = motion(10)[0]
    M = coupled.mass_matrix(s)
    assert np.all(np.linalg.eigvalsh(M) > 0)
    np.testing.assert_allclose(
        M - bare.mass_matrix(s), np.broadcast_to(np.diag(COUPLED_ROTORS), M.shape)
    )


def test_every_motor_has_a_rotor_of_its_own_to_identify() -> None:
    # In joint coordinates, too, all rotors but the first two count beside the links.
    assert base_parameters(load_model("tx40@motors")).rank == 40


def test_limits_hold_every_position_of_the_joints(robots) -> None:
    coupled, serial = robots
    random = np.random.default_rng(0)
    q = random.uniform(serial.q_min, serial.q_max, (200, 6))
    s = q.copy()
    s[:, 5] += q[:, 4]
    assert np.all((coupled.q_min <= s) & (s <= coupled.q_max))
    np.testing.assert_allclose(coupled.flange_pose(s), serial.flange_pose(q), atol=1e-12)


def test_a_model_file_finds_it_again(robots) -> None:
    coupled, _ = robots
    again = RobotModel.from_dict(coupled.with_payload(LIGHT_LOAD).to_dict())
    at = motion(5)
    np.testing.assert_allclose(
        again.inverse_dynamics(*at), coupled.with_payload(LIGHT_LOAD).inverse_dynamics(*at)
    )


def test_an_arm_without_coupling_has_no_motor_side() -> None:
    with pytest.raises(SpecError, match="every motor of this arm moves only one joint"):
        load_model("ur5@motors")


# Momentum and Cᵀq̇ against Pinocchio's mass matrix and its derivative, and with loads


HEAVY_LOAD = Payload(3.0, (0.02, -0.05, 0.08), (0.01, 0.012, 0.008, 0.001, 0.0, -0.002))
STEP = 1e-6
SLIDING = """<robot name="gantry">
<link name="base"/><link name="cart"><inertial><origin xyz="0.1 0.2 0.3"/><mass value="4"/>
<inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0.01" ixz="0" iyz="0.02"/></inertial></link>
<link name="arm"><inertial><origin xyz="0.2 -0.1 0.1"/><mass value="2"/>
<inertia ixx="0.05" iyy="0.06" izz="0.04" ixy="0" ixz="0.01" iyz="0"/></inertial></link>
<link name="tip"><inertial><origin xyz="0 0.1 0.2"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="x" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0.5"/>
<limit lower="-1" upper="1" effort="100" velocity="1"/></joint>
<joint name="r" type="revolute"><parent link="cart"/><child link="arm"/><axis xyz="0 1 0.3"/>
<origin xyz="0.1 0 0.4" rpy="0.3 0.2 0.1"/><limit lower="-3" upper="3" effort="50" velocity="2"/>
</joint>
<joint name="z" type="prismatic"><parent link="arm"/><child link="tip"/><axis xyz="0 0.2 1"/>
<origin xyz="0 0.2 0.1"/><limit lower="-1" upper="1" effort="50" velocity="1"/></joint></robot>"""


@pytest.fixture(params=["ur5", "tx40@motors", "sliding"])
def arm(request, tmp_path):
    if request.param != "sliding":
        return RobotModel.from_arm(request.param, rotor_inertia=[0.4, 0.5, 0.3, 0.1, 0.1, 0.1])
    (tmp_path / "a.urdf").write_text(SLIDING)
    return RobotModel.from_urdf(tmp_path / "a.urdf", rotor_inertia=[0.4, 0.1, 0.2])


def test_momentum_is_mass_matrix_times_velocity(arm) -> None:
    q, qd, _ = motion(20, arm.n)
    p, _ = arm.momentum(arm.parameters(), q, qd)
    np.testing.assert_allclose(p, np.einsum("sij,sj->si", arm.mass_matrix(q), qd), atol=1e-12)


def test_the_other_part_is_the_gradient_of_the_kinetic_energy(arm) -> None:
    q, qd, _ = motion(20, arm.n, seed=1)
    _, found = arm.momentum(arm.parameters(), q, qd)
    for j, step in enumerate(STEP * np.eye(arm.n)):
        change = (arm.mass_matrix(q + step) - arm.mass_matrix(q - step)) / (2 * STEP)
        energy = 0.5 * np.einsum("si,sij,sj->s", qd, change, qd)
        np.testing.assert_allclose(found[:, j], energy, atol=1e-7)


def test_the_momentum_changes_as_the_torques_say(arm) -> None:
    """dp/dt = τ − g + Cᵀq̇: what an observer without accelerations rests on."""
    q, qd, qdd = motion(20, arm.n, seed=2)
    phi, still = arm.parameters(), np.zeros_like(q)
    after, before = (arm.momentum(phi, q + s * STEP * qd, qd + s * STEP * qdd)[0] for s in (1, -1))
    forced = arm.torque(phi, q, qd, qdd) - arm.torque(phi, q, still, still)
    expected = forced + arm.momentum(phi, q, qd)[1]
    np.testing.assert_allclose((after - before) / (2 * STEP), expected, atol=1e-6)


def test_parameters_that_no_link_has_will_do(arm) -> None:
    q, qd, _ = motion(20, arm.n)
    base = base_parameters(arm, rotor=True)
    expanded = base.expand(base.combine(arm.parameters()))
    for mine, given in zip(
        arm.momentum(expanded, q, qd), arm.momentum(arm.parameters(), q, qd), strict=True
    ):
        np.testing.assert_allclose(mine, given, atol=1e-9)


def test_a_load_is_part_of_the_last_link(arm) -> None:
    q, qd, qdd = motion(20, arm.n)
    loaded = arm.loaded_parameters(arm.parameters(), HEAVY_LOAD)
    np.testing.assert_allclose(
        arm.torque(loaded, q, qd, qdd),
        arm.with_payload(HEAVY_LOAD).inverse_dynamics(q, qd, qdd),
        atol=1e-10,
    )


# Friction columns


QD = np.array([[0.5, -0.002], [0.0, -1.0], [0.01, 0.3]])


def test_coulomb_term_is_a_smooth_sign_of_the_given_width():
    coulomb = friction_terms(QD, sign_width=0.01)["coulomb"]
    assert coulomb[0, 0] == pytest.approx(1.0)
    assert coulomb[1, 1] == pytest.approx(-1.0)
    assert coulomb[1, 0] == 0.0
    assert coulomb[2, 0] == pytest.approx(np.tanh(1.0))


def test_width_zero_is_the_hard_sign():
    np.testing.assert_array_equal(friction_terms(QD, 0.0)["coulomb"], np.sign(QD))


def test_columns_times_coefficients_is_the_friction_law_of_each_joint():
    fc, fv, f0 = np.array([3.0, 5.0]), np.array([7.0, 11.0]), np.array([0.1, -0.2])
    expected = fc * np.tanh(QD / 0.02) + fv * QD + f0
    columns = joint_columns(friction_terms(QD, sign_width=0.02))
    assert columns.shape == (6, 6)
    coefficients = np.stack([fc, fv, f0], axis=1).ravel()  # joint by joint
    np.testing.assert_allclose(columns @ coefficients, expected.ravel())


def test_every_joint_has_columns_of_its_own():
    columns = joint_columns({"a": QD, "b": QD**2}).reshape(3, 2, 2, 2)
    assert not columns[:, 0, 1].any()
    assert not columns[:, 1, 0].any()
    np.testing.assert_array_equal(columns[:, 1, 1, 1], QD[:, 1] ** 2)


# Robot models as documents: how a model was made comes back, through JSON


WALL = (-9.81, 0.0, 0.3)
LOADS = (Payload(2.8, (0.03, -0.15, 0.06), (0.011, 0.014, 0.009, 0.001, -0.002, 0.0005)),
         Payload(0.5, (0.0, 0.0, 0.1)))  # fmt: skip


def through_json(robot):
    return RobotModel.from_dict(json.loads(json.dumps(robot.to_dict())))


def assert_same(again, robot):
    for sample in (motion(5), motion(5, seed=1)):
        ours, theirs = (each.inverse_dynamics(*sample) for each in (robot, again))
        np.testing.assert_array_equal(theirs, ours)
    np.testing.assert_array_equal(again.parameters(), robot.parameters())
    assert again.to_dict() == robot.to_dict()


@pytest.mark.parametrize("name", ["ur5", "lab6"])
def test_arm_comes_back_with_mounting_rotors_and_loads(name):
    robot = load_model(name, ROTORS, WALL)
    for load in LOADS:
        robot = robot.with_payload(load)
    assert robot.payloads == LOADS
    assert_same(through_json(robot), robot)


def test_urdf_comes_back_from_its_path_with_its_flange(tmp_path):
    file = written(tmp_path, urdf("ur5"))
    robot = RobotModel.from_urdf(file, ROTORS, WALL).with_payload(LOADS[0])
    document = robot.to_dict()
    assert (document["kind"], document["name"]) == ("urdf", str(file))
    assert_same(through_json(robot), robot)


def test_document_of_a_plain_arm_says_that_it_stands_upright():
    document = load_model("ur5").to_dict()
    assert document["gravity_m_s2"] == [0.0, 0.0, -9.81]
    assert document["rotor_inertia_kgm2"] == [0.0] * 6
    assert document["payloads"] == []


def test_unknown_arm_is_refused():
    with pytest.raises(SpecError, match="no built-in arm 'ur7'"):
        RobotModel.from_dict(load_model("ur5").to_dict() | {"name": "ur7"})


def test_arm_descriptions_are_parsed_once_and_cannot_be_written():
    arm = load_arm("ur5")
    assert load_arm("ur5") is arm
    for name in ("dh", "q_min", "mass", "com", "inertia", "drive_gains"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(arm, name)[0] = 0.0
