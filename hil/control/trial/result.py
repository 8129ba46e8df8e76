"""What came of a trial, and its form as JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.control.trial.arm import RATE_HZ
from hil.control.trial.gains import Spring
from hil.control.trial.judged import judged
from hil.control.trial.leading import HAND_FIRMNESS, Led
from hil.control.trial.reference import Leading
from hil.control.trial.settings import SPEED_HZ
from hil.control.trial.tracking import Tracked
from hil.core import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What a model was worth to a controller.

    Attributes:
        model: Its folder.
        estimator: What fitted it.
        robot: Name in the station, and the station in words.
        serial: Of the arm it was tried on.
        fitted_on: Serial number of the arm it was fitted on; empty when nobody said.
        joint_names: Length n.
        payload: What was mounted.
        seed: Of the trajectory.
        friction_share: Of the dry friction, compensated while a hand leads.
        pd: The controller that all laws share.
        tracked: A run for each law.
        leading: The way of the hand.
        led: A run for each way of helping the hand.
        seconds: It all took.
        notes: What else one should know, the gravest first.
    """

    model: str
    estimator: str
    robot: str
    serial: str
    fitted_on: str
    joint_names: tuple[str, ...]
    payload: Payload
    seed: int
    friction_share: float
    pd: Spring
    tracked: tuple[Tracked, ...]
    leading: Leading
    led: tuple[Led, ...]
    seconds: float
    notes: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether the model met all that it is held to (`hil.control.trial.judged`)."""
        return all(criterion.met for criterion in judged(self))

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil try-out --json`."""
        return {
            "ok": self.ok,
            "criteria": [asdict(criterion) for criterion in judged(self)],
            "model": self.model,
            "estimator": self.estimator,
            "robot": self.robot,
            "serial": self.serial,
            "fitted_on": self.fitted_on,
            "joint_names": list(self.joint_names),
            "payload": {"mass_kg": self.payload.mass, "com_m": list(self.payload.com)},
            "seed": self.seed,
            "rate_hz": RATE_HZ,
            "pd": {
                "stiffness_nm_rad": self.pd.stiffness.tolist(),
                "damping_nms_rad": self.pd.damping.tolist(),
            },
            "tracking": [_tracked(run) for run in self.tracked],
            "hand": {
                "firmness": HAND_FIRMNESS,
                "friction_share": self.friction_share,
                "speed_low_pass_hz": SPEED_HZ,
                "swing_rad": self.leading.swing.tolist(),
                "led": [_led(run) for run in self.led],
            },
            "seconds": self.seconds,
            "notes": list(self.notes),
        }


def _numbers(values: FloatArray) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]


def _tracked(run: Tracked) -> dict[str, Any]:
    return {
        "law": run.law,
        "rms_rad": _numbers(run.rms),
        "worst_rad": _numbers(run.worst),
        "stopped": run.stopped,
    }


def _led(run: Led) -> dict[str, Any]:
    return {
        "way": run.way,
        "rms_nm": _numbers(run.rms),
        "peak_nm": _numbers(run.peak),
        "ran_on_rad": _numbers(run.ran_on),
        "rest_after_s": run.rest_s if np.isfinite(run.rest_s) else None,
        "stopped": run.stopped,
    }
