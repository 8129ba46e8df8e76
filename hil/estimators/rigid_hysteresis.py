"""Rigid-body dynamics with friction that remembers, depends on load, and is chosen by the data.

What classical friction models lack is memory: a joint that turns round, or stands still, has the
friction its last millirad left it with. Dahl's states carried along the measured path take the
place of sign(v); friction grows with the torque through the gear; gears and motors ripple. Which
of the library's columns (`hil.estimators.friction.library`) a joint gets is decided by leaving
whole training trajectories out, shapes are fitted by variable projection, and the links are those
of a robot that can exist.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray
from hil.data import Dataset, FilterSettings, Prediction, SeriesKind, Stream, rows_to_fit
from hil.dynamics import RobotModel, base_parameters
from hil.estimators.base import RobotEstimator, chunks, payload_torque, prepared
from hil.estimators.checks import (
    Needs,
    require_clean,
    require_motion,
    require_plausible,
    require_robot,
    require_sizes,
    torque_scale,
)
from hil.estimators.consistent import IDENTIFY
from hil.estimators.friction.carried import RememberingStream
from hil.estimators.friction.hysteresis_fit import HysteresisFit
from hil.estimators.friction.law import FrictionLaw
from hil.estimators.friction.motion import Shapes
from hil.estimators.friction.predicted import predicted_friction
from hil.estimators.hysteresis_settings import filters_for, group_names, motor_turns
from hil.estimators.parameters import flag, number, settings

MOTION = ("q_f", "qd_f", "qdd_f")

FRICTION_SAMPLES = 10
"""Samples per joint for its friction, beside those for the links."""


class RigidHysteresis(RobotEstimator):
    """The default for dynamics: a robot that can exist, with friction that remembers.

    Args:
        friction: `auto` lets training trajectories that are left out choose among a few nested
            lists of groups, joint by joint; or the groups every joint has.
        fit_shapes: Fit lengths, Stribeck speeds and exponents; False keeps the usual ones.
        consistent: Links that can exist; needs the extra `identify`.
        gear_ratio: Motor turns per joint turn, for ripple; by default the arm's, if known.
        filters: Preprocessing of training and prediction alike; by default 11 Hz for motion and
            17.6 Hz for effort, whatever the sample rate, and more for arms that move quicker.

    Attributes:
        rigid_: (b,) base parameters.
        inertial_: (11n,) of a robot that can exist; absent without `consistent`.
        law_: Friction, ripple and drive.
        filters_: Those that were used.
        gear_rigid_: (b,) base parameters the torque through the gears was computed with.
        held_out_: (n,) error on left-out trajectories, filtered, in effort units; the same
            trajectories chose the groups.
        parameter_names_: Base parameters, then every joint's friction.
    """

    estimator: ClassVar[str] = "rigid-hysteresis"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",), ("move",))

    inertial_: FloatArray

    def __init__(
        self,
        *,
        friction: str | Sequence[str] = "auto",
        fit_shapes: bool = True,
        consistent: bool = True,
        gear_ratio: float | None = None,
        filters: FilterSettings | dict[str, Any] | None = None,
    ) -> None:
        self.friction = group_names("friction", friction)
        self.fit_shapes = flag("fit_shapes", fit_shapes)
        self.consistent = flag("consistent", consistent)
        self.gear_ratio = None if gear_ratio is None else number("gear_ratio", gear_ratio, above=0)
        self.filters = None if filters is None else settings("filters", filters, FilterSettings)

    def extras(self) -> dict[str, str]:
        """A solver of semidefinite programs, if the links are to be such that can exist."""
        purpose = f"{IDENTIFY['identify']}; consistent: false does without"
        return {"identify": purpose} if self.consistent else {}

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what a fit cannot do without: samples for links and friction, and drive gains."""
        rank = base_parameters(robot, rotor=True).rank
        return Needs({"samples": rank + FRICTION_SAMPLES * robot.n}, gains=True)

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit to every series given; declared loads are part of what the gears transmit.

        Raises:
            FitError: The data are too few, not finite, of another robot or unit, hold efforts
                that cannot be, or do not excite all parameters.
            DataError: A series cannot be filtered.
            PluginError: The extra `identify` is missing.
        """
        require_robot(dataset, robot)
        self._remember(dataset, robot, torque_scale(dataset))
        require_clean(dataset, ("t", "q", "effort"))
        require_plausible(dataset, robot)
        self._base = base_parameters(robot, rotor=True)
        self.needs(robot).require(samples=len(dataset))
        require_motion(dataset)
        self.filters_ = self.filters or filters_for(dataset)
        data = prepared(dataset, self.filters_)
        turns = motor_turns(robot, self.gear_ratio)
        learnt = HysteresisFit(self._base, robot, self.filters_, turns).learn(
            data,
            self.torque_scale_,
            friction=self.friction,
            fit_shapes=self.fit_shapes,
            consistent=self.consistent,
        )
        self.rigid_, self.gear_rigid_, self.law_ = learnt.rigid, learnt.gear_rigid, learnt.law
        if learnt.inertial is not None:
            self.inertial_ = learnt.inertial
        self.samples_, self.notes_ = learnt.samples, learnt.notes
        self.held_out_ = learnt.held_out / self.torque_scale_
        scatter = (data["effort"] - data["effort_f"])[rows_to_fit(data)]
        self.sigma_ = np.sqrt(self.held_out_**2 + np.mean(scatter**2, axis=0))
        self._name_parameters()
        return self

    def predict(self, dataset: Dataset) -> Prediction:
        """Effort per row: `gravity`, `inertia`, `friction`, `ripple`, `drive`, `payload`.

        Friction is filtered like the motion it follows from.

        Raises:
            DataError: The data are of another robot or unit, or cannot be filtered.
        """
        self.require_match(dataset)
        data = prepared(dataset, self.filters_)
        motion = tuple(data[name] for name in MOTION)
        load = payload_torque(self.robot_, data, *motion)
        torque, gravity, transmitted = self._rigid_torques(data, load)
        parts = {"gravity": gravity, "inertia": torque - gravity, "payload": load}
        parts |= predicted_friction(self.law_, data, transmitted, self.filters_)
        parts = {name: part / self.torque_scale_ for name, part in parts.items()}
        effort: FloatArray = np.sum(list(parts.values()), axis=0)
        std = np.broadcast_to(self.sigma_, effort.shape)
        return Prediction(effort, std, np.isfinite(effort), parts)

    def stream(self, payload: Payload | None = None) -> Stream:
        """A predictor for one sample at a time that carries the friction states with it.

        It filters nothing: give it motion as smooth as the training's.
        """
        load = payload or Payload()

        def torque(*motion: FloatArray) -> tuple[FloatArray, FloatArray]:
            Y = self._base.regressor(self.robot_, *motion)
            carried = np.zeros_like(motion[0])
            if not load.is_empty:
                carried = self.robot_.payload_effort(load, *motion)
            rigid, gears = (Y @ beta for beta in (self.rigid_, self.gear_rigid_))
            shape = carried.shape
            return rigid.reshape(shape) + carried, gears.reshape(shape) + carried

        return RememberingStream(torque, self.law_, self.torque_scale_)

    def break_away(self) -> FloatArray:
        """Return the friction (n,) that an unloaded joint at rest holds before it slides [N·m]."""
        return self.law_.break_away()

    def _rigid_torques(
        self, data: Dataset, load: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rigid body, its gravity, and the torque through the gears, each (N, n) [N·m]."""
        torque, gravity, transmitted = (np.empty_like(load) for _ in range(3))
        for rows in chunks(data):
            q, qd, qdd = (data[name][rows] for name in MOTION)
            still = np.zeros_like(q)
            Y = self._base.regressor(self.robot_, q, qd, qdd)
            torque[rows] = (Y @ self.rigid_).reshape(q.shape)
            transmitted[rows] = (Y @ self.gear_rigid_).reshape(q.shape) + load[rows]
            at_rest = self._base.regressor(self.robot_, q, still, still)
            gravity[rows] = (at_rest @ self.rigid_).reshape(q.shape)
        return torque, gravity, transmitted

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Rigid body, friction and its shapes, gains and deviations."""
        arrays = {
            "rigid": self.rigid_,
            "gear_rigid": self.gear_rigid_,
            "friction": np.concatenate(self.law_.coefficients),
            "shapes": self.law_.shapes.to_array(),
            "held_out": self.held_out_,
            "torque_scale": self.torque_scale_,
            "sigma": self.sigma_,
        }
        if self.law_.celsius is not None:
            arrays["celsius"] = self.law_.celsius
        inertial = getattr(self, "inertial_", None)
        return arrays if inertial is None else arrays | {"inertial": inertial}

    def fitted_facts(self) -> dict[str, Any]:
        """Names of all parameters, and which groups every joint has."""
        return super().fitted_facts() | {
            "parameter_names": list(self.parameter_names_),
            "friction": [list(names) for names in self.law_.chosen],
            "filters": self.filters_.model_dump(),
        }

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        self._restore_common(arrays, facts)
        self._base = base_parameters(self.robot_, rotor=True)
        self.rigid_, self.gear_rigid_ = arrays["rigid"], arrays["gear_rigid"]
        if not self.rigid_.shape == self.gear_rigid_.shape == (self._base.rank,):
            raise ValueError(f"rigid: {self.rigid_.size} values for {self._base.rank} parameters")
        self.held_out_ = arrays["held_out"]
        self.filters_ = FilterSettings.model_validate(facts["filters"])
        if "inertial" in arrays:
            self.inertial_ = arrays["inertial"]
            require_sizes(self, inertial=11 * self.robot_.n)
        chosen = tuple(tuple(map(str, names)) for names in facts["friction"])
        self.law_ = FrictionLaw.from_flat(
            chosen,
            arrays["friction"],
            Shapes.from_array(arrays["shapes"]),
            arrays.get("celsius"),
        )
        self._name_parameters()

    def _name_parameters(self) -> None:
        self.parameter_names_ = (*self._base.names, *self.law_.parameter_names(self.joint_names_))
