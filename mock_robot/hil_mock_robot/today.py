"""The robot as it is today: which one, in what room, and how worn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hil.core import FloatArray, SpecError
from hil_mock_robot.draw import draw_truth
from hil_mock_robot.options import Options, numbers_of, wrong_option
from hil_mock_robot.truth import Truth

WEAR = (0.1, 10.0)
"""Least and most of what friction becomes by wear."""

GOLDEN_RAD = 2.399963
"""Golden angle: the phases of days one after the other are never alike."""


def truth_of(model: str, options: Options) -> Truth:
    """The robot that the options name, in its room on that day.

    Raises:
        SpecError: There is no such arm or profile, or the file is another arm's.
        DataError: The file cannot be used.
    """
    truth = _robot_of(model, options)
    room = truth.ambient_c if options.room_c is None else options.room_c
    phase = truth.ambient_phase_rad + options.day * GOLDEN_RAD
    return replace(truth, ambient_c=room, ambient_phase_rad=phase)


def _robot_of(model: str, options: Options) -> Truth:
    """The robot itself.

    Raises:
        SpecError: There is no such arm or profile, or the file is another arm's.
        DataError: The file cannot be used.
    """
    if options.truth_file is None:
        return draw_truth(model, options.seed, options.profile)
    truth = Truth.from_json(options.truth_file)
    if truth.arm != model:
        raise SpecError(
            f"{options.truth_file} is the truth of a {truth.arm}, the station says {model}",
            hint=f"set model: {truth.arm}",
        )
    return truth


def wear_of(options: Options, n: int) -> FloatArray:
    """(n,) factor on each joint's friction.

    Raises:
        SpecError: It is not n factors that can be.
    """
    if options.wear is None:
        return np.ones(n)
    factors = numbers_of(options.wear, n)
    least, most = WEAR
    if factors is None or not all(least <= factor <= most for factor in factors):
        hint = f"give {n} factors from {least:g} to {most:g}, 1 for as good as new"
        raise wrong_option("wear", options.wear, hint)
    return np.array(factors)
