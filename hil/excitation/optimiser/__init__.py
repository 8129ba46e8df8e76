"""Fourier excitations made to identify well: condition or determinant under all limits."""

from hil.excitation.optimiser.problem import Distances, ExcitationProblem, Objective
from hil.excitation.optimiser.result import Margins, Optimised, Progress, ProgressCallback, Start
from hil.excitation.optimiser.solve import optimise

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
