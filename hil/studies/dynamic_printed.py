"""Table II of the PINN paper: RMSE [N·m] of joint torques, its robot a ROKAE XB7S.

The text that came with this project has a stray 0 behind the first digit of every figure ("50.19"
for 5.19); with it taken out, the mean of every row is the printed average.
"""

from __future__ import annotations

TABLE_II: dict[str, tuple[float, ...]] = {
    "wls": (8.47, 14.07, 5.35, 1.51, 1.11, 0.61),
    "lmi": (6.23, 8.83, 3.15, 2.15, 2.23, 0.98),
    "irls": (7.30, 8.67, 3.54, 1.23, 0.84, 0.52),
}
"""By key of `hil.studies.dynamic_methods`: Methods 1, 2 and 3."""

AVERAGES = {"wls": 5.19, "lmi": 3.93, "irls": 3.68}
"""As printed."""
