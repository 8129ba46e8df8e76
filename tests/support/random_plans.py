"""Plans of every shape a plan may have, drawn by hypothesis."""

from __future__ import annotations

import math
from typing import Any

from hypothesis import strategies as st

from hil.arms.payload import Payload
from hil.excitation.motion import FourierSeries, Hold, Line, Motion
from hil.planning.plan import DwellRule, LoadStep, Plan, Step

positive = st.floats(1e-3, 1e3)
limits = st.floats(1e-2, 1e3)
"""Of lines; below, a motion may take longer than a plan file may hold."""
finite = st.floats(allow_nan=False, allow_infinity=False)
angles = st.floats(-7.0, 7.0) | st.sampled_from([0.0, -0.0, 5e-324, math.pi])
MOVING = ("warmup", "move")
STILL = ("dwell", "reference", "weigh")


def vector(n: int, values: st.SearchStrategy[float] = angles) -> st.SearchStrategy[Any]:
    return st.lists(values, min_size=n, max_size=n).map(tuple)


def lines(n: int) -> st.SearchStrategy[Line]:
    return st.builds(Line, vector(n), vector(n), limits, limits, limits, st.just(125.0))


@st.composite
def fourier_series(draw: st.DrawFn, n: int) -> FourierSeries:
    harmonics = draw(st.integers(1, 5))
    rows = st.lists(vector(harmonics), min_size=n, max_size=n).map(tuple)
    fundamental = draw(st.floats(0.01, 2.0))
    return FourierSeries(
        draw(vector(n)), draw(rows), draw(rows), fundamental, draw(st.integers(1, 20))
    )


@st.composite
def steps(draw: st.DrawFn, index: int, n: int, loads: int) -> Step:
    kind = draw(st.sampled_from(["payload", "trajectory", *MOVING, *STILL]))
    motion: Motion | None = None
    if kind in MOVING:
        motion = draw(lines(n))
    elif kind in STILL:
        motion = Hold(draw(vector(n)))
    elif kind == "trajectory":
        motion = draw(fourier_series(n))
    numbers = st.integers(-1, 10**6)
    return Step(
        index,
        kind,  # type: ignore[arg-type]
        motion,
        draw(numbers),
        draw(numbers),
        draw(st.sampled_from([-1, 0, 1])),
        draw(st.integers(0, loads - 1)),
        draw(st.booleans()),
    )


payloads = st.builds(Payload, st.floats(0, 50), vector(3, finite), vector(6, finite))
load_steps = st.builds(
    LoadStep, payloads, st.text(max_size=20), st.none() | vector(2, st.floats(0, 2))
)
rules = st.builds(DwellRule, st.floats(0, 600), st.integers(1, 10_000), positive, positive)


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """A plan of one to seven joints, at most eight steps."""
    n = draw(st.integers(1, 7))
    loads = draw(st.lists(load_steps, min_size=1, max_size=3))
    count = draw(st.integers(0, 8))
    names = draw(st.lists(st.text(max_size=8), min_size=n, max_size=n, unique=True))
    return Plan(
        name=draw(st.text(max_size=20)),
        robot_model=draw(st.text(max_size=20)),
        joint_names=tuple(names),
        rate_hz=draw(st.sampled_from([125, 125.0, 500.0, 1e-3, 333.3])),
        steps=tuple(draw(steps(index, n, len(loads))) for index in range(count)),
        loads=tuple(loads),
        dwell=draw(rules),
        margins=draw(st.dictionaries(st.text(max_size=8), finite | st.just(math.inf), max_size=4)),
        condition_number=draw(positive | st.just(math.inf)),
    )


def small_plan() -> Plan:
    """Two joints, one of every kind of motion, two loads."""
    here, there = (0.0, 0.0), (0.5, -0.25)
    series = FourierSeries(here, ((0.1, -0.1),) * 2, ((0.2, -0.1),) * 2, 0.5)
    return Plan(
        name="small",
        robot_model="toy",
        joint_names=("joint 1", "joint 2"),
        rate_hz=125.0,
        steps=(
            Step(0, "payload", load=1, checkpoint=True),
            Step(1, "move", Line(here, there, 1.0, 2.0, 20.0, 125.0), load=1),
            Step(2, "dwell", Hold(there), pose=0, approach=1, load=1),
            Step(3, "trajectory", series, trajectory=0, load=1, checkpoint=True),
        ),
        loads=(
            LoadStep(Payload()),
            LoadStep(Payload(3.0, (0.0, 0.0, 0.05)), "Mount it", (0.1, 0.05)),
        ),
        margins={"position_rad": 1.5, "clearance_m": math.inf},
        condition_number=12.5,
    )
