"""Fourier excitations made to identify well: condition or determinant under all limits."""

from hil.excite.optimise.problem import Distances, ExcitationProblem, Objective
from hil.excite.optimise.result import Margins, Optimised, Progress, ProgressCallback, Start
from hil.excite.optimise.solve import optimise

__all__ = [
    "Distances",
    "ExcitationProblem",
    "Margins",
    "Objective",
    "Optimised",
    "Progress",
    "ProgressCallback",
    "Start",
    "optimise",
]
