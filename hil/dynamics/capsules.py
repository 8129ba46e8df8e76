"""Where the capsules of an arm are, for many joint positions at once, and how far they reach."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.arms import ArmDescription, Capsule
from hil.core import FloatArray


class CapsuleChain:
    """The axes of capsules that move with the links of a DH arm.

    Args:
        arm: The arm.
        capsules: Bodies in their links' frames; link 0 is the base.
    """

    def __init__(self, arm: ArmDescription, capsules: Sequence[Capsule]) -> None:
        self._dh = arm.dh
        self._capsules = tuple(capsules)
        self._of_link = [
            np.flatnonzero([capsule.link == link for capsule in capsules])
            for link in range(arm.n_joints + 1)
        ]
        self._local = [
            np.array([_ends(c) for c in capsules if c.link == link]).reshape(-1, 4)
            for link in range(arm.n_joints + 1)
        ]

    def axes(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Starts and directions of all axes in the base frame, each (3, C, N), for `q` (N, n)."""
        out = np.empty((2, 3, len(self._capsules), len(q)))
        # Columns x, y, z and origin of the current link's frame: (3, 4, N).
        frame = np.zeros((3, 4, len(q)))
        frame[[0, 1, 2], [0, 1, 2]] = 1.0
        self._place(out, 0, frame)
        for link, (a, alpha, d, theta) in enumerate(self._dh, 1):
            frame = _next_frame(frame, a, alpha, d, q[:, link - 1] + theta)
            self._place(out, link, frame)
        return out[0], out[1]

    def reach(self, fixed: int, body: int) -> FloatArray:
        """(n,) how far [m] the axis of the capsule number `body` can be from each joint axis.

        Seen from link `fixed`: joints that do not move the capsule against that link have 0.
        """
        capsule = self._capsules[body]
        tip = max(float(np.linalg.norm(end)) for end in (capsule.a, capsule.b))
        out = np.zeros(len(self._dh))
        for joint in range(capsule.link - 1, fixed - 1, -1):
            a, _, d, _ = self._dh[joint]
            # d lies along the joint's own axis, so it counts from the next joint inwards only.
            out[joint] = abs(a) + tip
            tip += float(np.hypot(a, d))
        return out

    def _place(self, out: FloatArray, link: int, frame: FloatArray) -> None:
        of_link = self._of_link[link]
        if len(of_link):
            ends = np.matmul(self._local[link], frame)
            out[:, :, of_link] = ends.reshape(3, len(of_link), 2, ends.shape[-1]).transpose(
                2, 0, 1, 3
            )


def _ends(capsule: Capsule) -> FloatArray:
    """(2, 4) start as a point and direction as a vector."""
    a, b = np.array(capsule.a, dtype=np.float64), np.array(capsule.b, dtype=np.float64)
    return np.array([[*a, 1.0], [*(b - a), 0.0]])


def _next_frame(
    frame: FloatArray, a: float, alpha: float, d: float, angle: FloatArray
) -> FloatArray:
    """Standard DH: turn about z, shift along z and the new x, turn about the new x."""
    x, y, z, origin = frame.transpose(1, 0, 2)
    c, s = np.cos(angle), np.sin(angle)
    x, y = c * x + s * y, c * y - s * x
    out = np.empty_like(frame)
    out[:, 0] = x
    out[:, 1] = np.cos(alpha) * y + np.sin(alpha) * z
    out[:, 2] = np.cos(alpha) * z - np.sin(alpha) * y
    out[:, 3] = origin + d * z + a * x
    return out
