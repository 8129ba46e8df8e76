"""Motions for tests of the mock robot: smooth, from rest to rest, inside the limits."""

import numpy as np

from hil.robot import Segment, Status


def blend(start, end, rate_hz, duration_s):
    """Fifth-order blend between two poses as set-points (N, 3, n)."""
    s = np.linspace(0, 1, round(duration_s * rate_hz) + 1)[:, None]
    way = np.asarray(end, float) - np.asarray(start, float)
    q = start + way * (10 * s**3 - 15 * s**4 + 6 * s**5)
    qd = way * 30 * s**2 * (1 - s) ** 2 / duration_s
    qdd = way * 60 * s * (1 - s) * (1 - 2 * s) / duration_s**2
    return np.stack((q, qd, qdd), axis=1)


def hold(setpoints, rate_hz, duration_s):
    """The last set-point, repeated."""
    return np.repeat(setpoints[-1:], round(duration_s * rate_hz), axis=0)


def fourier(start, rate_hz, seed, period_s=10.0, peak_rad_s=0.8):
    """One period of a random five-harmonic motion that starts and ends at `start`, at rest."""
    rng = np.random.default_rng(seed)
    t = np.arange(1, round(period_s * rate_hz) + 1)[:, None] / rate_hz
    q = np.zeros((len(t), len(start)))
    qd, qdd = q.copy(), q.copy()
    for h in range(1, 6):
        w, a = 2 * np.pi * h / period_s, rng.normal(size=len(start))
        q += a / w * (1 - np.cos(w * t))
        qd += a * np.sin(w * t)
        qdd += a * w * np.cos(w * t)
    scale = peak_rad_s / np.abs(qd).max()
    path = np.stack((start + scale * q, scale * qd, scale * qdd), axis=1)
    path[-1, 1:] = 0.0
    return path


def segment(setpoints, index=0, kind="trajectory"):
    """A segment of set-points (N, 3, n)."""
    q, qd, qdd = (np.ascontiguousarray(setpoints[:, k]) for k in range(3))
    return Segment(index, kind, q, qd, qdd, float(np.abs(qd).max()), float(np.abs(qdd).max()))


def play(robot, piece):
    """Prepare, start and read one segment to its end; returns its rows.

    In wall time rows from before its start may still come, and some after its end.
    """
    robot.prepare(piece)
    robot.start()
    blocks = [robot.read()]
    while blocks[-1]["segment"][-1] != piece.index or not (
        blocks[-1]["status"][-1] & Status.HOLDING
    ):
        blocks.append(robot.read())
    rows = np.concatenate(blocks)
    return rows[rows["segment"] == piece.index]


UPRIGHT = np.radians([0.0, -90.0, 0.0, -90.0, 0.0, 0.0])
ASIDE = UPRIGHT + np.radians([30.0, 20.0, -40.0, 30.0, 25.0, -60.0])


def move(start=UPRIGHT, end=ASIDE, index=0, duration_s=1.6, rate_hz=125):
    """From rest to rest, for a UR5."""
    return segment(blend(start, end, rate_hz, duration_s), index, "move")
