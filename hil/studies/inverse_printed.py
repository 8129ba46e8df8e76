"""Table II of the PINN paper beyond Methods 1 to 3: RMSE [N·m] of joint torques of a ROKAE XB7S.

The stray 0 behind the first digit of every figure is taken out, as in
`hil.studies.dynamic_printed`: with that, the mean of every row is the printed average.
"""

from __future__ import annotations

from hil.studies.dynamic_printed import AVERAGES, TABLE_II

PRINTED: dict[str, tuple[float, ...]] = {
    **TABLE_II,
    "delan": (86.61, 129.84, 73.14, 47.27, 15.76, 32.91),
    "delan-unconstrained": (45.77, 29.26, 19.58, 47.41, 9.52, 11.04),
    "delan-coulomb": (8.35, 11.72, 11.75, 8.48, 6.92, 4.10),
    "proposed": (6.29, 10.73, 4.11, 1.38, 0.65, 0.63),
    "rc-paper": (3.95, 5.80, 2.91, 0.72, 0.42, 0.40),
}
"""By key of `hil.studies.inverse_methods`."""

PRINTED_AVERAGES: dict[str, float] = {
    **AVERAGES,
    "delan": 64.25,
    "delan-unconstrained": 27.10,
    "delan-coulomb": 8.55,
    "proposed": 3.97,
    "rc-paper": 2.37,
}
"""As printed."""
