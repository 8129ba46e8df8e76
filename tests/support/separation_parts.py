"""A small dwell program for tests of the separation study: gravity, stick friction, noise."""

from __future__ import annotations

import numpy as np

from hil.data.arrivals import ARRIVAL_POINTS
from hil.data.dataset import Conditions, Dataset
from hil.dynamics import RobotModel, load_model

FRICTION = np.array([0.30, 0.40, 0.12, 0.10, 0.04, 0.03])
"""Level of stick friction [A]."""

SAMPLES = 10
STEP_S = 0.008


def robot() -> RobotModel:
    return load_model("ur5")


def program(
    poses: int = 60,
    *,
    approaches: tuple[int, ...] = (1, -1),
    noise: float = 0.01,
    kept: bool = True,
    seed: int = 0,
) -> Dataset:
    """Dwells at random poses, each approached from every side asked for.

    Args:
        poses: How many.
        approaches: Sides of each.
        noise: Of a sample [A].
        kept: Whether a joint keeps all of its friction when it stops; else it slides back by up to
            0.1 mrad and loses as much of it, up to a half, as the path shows.
        seed: Of everything drawn.
    """
    draw = np.random.default_rng(seed)
    model, gains = robot(), np.array([10.0, 10.0, 10.0, 8.0, 8.0, 8.0])
    places = np.repeat(draw.uniform(-2.0, 2.0, (poses, 6)), len(approaches), axis=0)
    side = np.tile(approaches, poses)[:, None]
    slid = np.zeros_like(places) if kept else draw.uniform(0.0, 1e-4, places.shape)
    held = model.gravity(places) / gains + side * FRICTION * (1.0 - 0.5 * slid / 1e-4)
    rows = np.repeat(np.arange(len(places)), SAMPLES)
    clean = places[rows] + draw.normal(0.0, 2e-5, (len(rows), 6))
    effort = held[rows] + draw.normal(0.0, noise, (len(rows), 6))
    return Dataset(
        robot="ur5",
        joint_names=tuple(model.joint_names),
        effort_kind="current",
        columns={
            "t": np.arange(len(rows)) * STEP_S,
            "q": clean,
            "qd": np.zeros_like(clean),
            "effort": effort,
        },
        offsets=np.arange(len(places) + 1) * SAMPLES,
        conditions=tuple(
            Conditions(
                f"pose{k // len(approaches)}/{int(s):+d}",
                "dwell",
                source="program",
                pose=k // len(approaches),
                approach=int(s),
            )
            for k, s in enumerate(side[:, 0])
        ),
        drive_gains=gains,
        drive_gains_source="the program",
        arrivals=_paths(side * np.ones((1, 6)), slid),
    )


def _paths(side: np.ndarray, slid: np.ndarray) -> np.ndarray:
    """(S, ARRIVAL_POINTS, 2, 6): from 1 mrad away past the place of rest by `slid`, and back."""
    half = ARRIVAL_POINTS // 2
    there = np.linspace(-1e-3, 0.0, half)[:, None, None] * side + np.linspace(0.0, 1.0, half)[
        :, None, None
    ] * (slid * side)
    back = np.linspace(1.0, 0.0, ARRIVAL_POINTS - half)[:, None, None] * (slid * side)
    q = np.concatenate([there, back]).transpose(1, 0, 2)
    return np.stack([q, np.gradient(q, STEP_S, axis=1)], axis=2)
