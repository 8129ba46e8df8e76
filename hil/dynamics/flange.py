"""How far the flange of an arm is from the faces of the space it has to stay in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.arms import ArmDescription, Capsule
from hil.core import FloatArray
from hil.dynamics.capsules import CapsuleChain
from hil.dynamics.distances import plane_distance
from hil.dynamics.environment import Plane


class FlangeSpace:
    """Signed distances of points at the flange to planes, negative behind one.

    Args:
        arm: The arm.
        faces: The planes it must stay in front of, in the base frame.
        tip_m: How far the tip of a payload is out along the flange axis; 0 for none.

    Attributes:
        names: (R,) point and plane of each distance.
        reach: (R, n) metres that a distance can change per radian of each joint, at most.
    """

    def __init__(self, arm: ArmDescription, faces: Sequence[Plane], tip_m: float = 0.0) -> None:
        at = {"flange": 0.0} | ({"payload": tip_m} if tip_m else {})
        points = [Capsule(arm.n_joints, (0.0, 0.0, z), (0.0, 0.0, z), 0.0) for z in at.values()]
        self._chain = CapsuleChain(arm, points)
        self._faces = tuple(faces)
        self.names = [(point, face.name) for face in faces for point in at]
        reach = [self._chain.reach(0, point) for point in range(len(points))]
        self.reach = np.array(len(faces) * reach).reshape(-1, arm.n_joints)

    def own(self) -> FlangeSpace:
        """The same: it keeps nothing from one call to the next."""
        return self

    def distances(self, q: FloatArray) -> FloatArray:
        """(R, N) distances [m] at `q` (N, n)."""
        axes = self._chain.axes(q)
        gaps = [plane_distance(*axes, np.array(f.point), f.unit_normal) for f in self._faces]
        return np.concatenate(gaps)
