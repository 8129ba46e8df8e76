"""Rigid-body dynamics with Coulomb and viscous friction by weighted least squares.

The base regressor of the arm (rotor inertias included) is set beside three friction columns per
joint, tanh(qd/width), qd and 1, and fitted to K·i: ordinary least squares first, then again with
every joint weighted by the reciprocal variance of its own residual (Jubien, Gautier & Janot 2014,
"Method 1" of the PINN paper).

On the UR10e recordings of Mamedov & Mikhel, with the filters of `hil.data.filters`, the literature
drive gains and a width of 0.01 rad/s, training on 30s12h + 40s12h + 50s12h + 20s8h gives on the
whole of 14h50 .234 .327 .172 .045 .052 .040 A raw (mean .1450) and .1145 A against the filtered
current; on 30s12h alone tanh gives .1485 and the hard sign .1642.
"""

from __future__ import annotations

from typing import Any, ClassVar

from hil.data import FilterSettings
from hil.estimators.least_squares import JointwiseQR, Solution, jointwise_least_squares
from hil.estimators.parameters import flag
from hil.estimators.rigid_linear import RigidLinear


class RigidWls(RigidLinear):
    """Base rigid-body parameters and Coulomb–viscous friction.

    Args:
        sign_width: Width of the tanh that stands for sign(qd) [rad/s]; 0 for the hard sign.
        weighted: Weight the joints by their residual; False stops after ordinary least squares.
        filters: Preprocessing of training and prediction alike, a `FilterSettings` or its dict.
    """

    estimator: ClassVar[str] = "rigid-wls"

    def __init__(
        self,
        *,
        sign_width: float = 0.01,
        weighted: bool = True,
        filters: FilterSettings | dict[str, Any] | None = None,
    ) -> None:
        super().__init__(sign_width=sign_width, filters=filters)
        self.weighted = flag("weighted", weighted)

    def _estimate(self, observed: JointwiseQR) -> Solution:
        return jointwise_least_squares(observed, weighted=self.weighted)
