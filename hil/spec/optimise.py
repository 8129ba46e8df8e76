"""What a spec may ask of trajectories that are optimised rather than drawn."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from hil.spec.field_types import IS_NUMBER, NonNegative, Positive, Seed, Strict


class Optimise(Strict):
    """Trajectories found by optimisation, each to complement those before it.

    `optimise: true` is the same as `optimise: {}`; `false` and `null` draw at random.
    """

    objective: Literal["log_det", "condition"] = Field(
        "log_det",
        description="What is made best: `log_det` makes the parameters' errors small (D-optimal), "
        "`condition` the condition number of the base regressor, which says how evenly the "
        "parameters are told and not how well.",
    )
    scaled: bool = Field(
        True,
        description="`condition` with every column of the regressor scaled to length 1; "
        "`false` takes the columns as they are, in mixed units.",
    )
    friction: bool = Field(
        False, description="Also tell Coulomb, viscous and offset friction of each joint apart."
    )
    rotor: bool = Field(
        True, description="Also tell the inertia of each joint's rotor apart from its link's."
    )
    starts: Annotated[int, Field(ge=1, le=1000), IS_NUMBER] = Field(
        3, description="Random starts for each trajectory, of which the best result is kept."
    )
    budget_s: Annotated[float, Field(gt=0, le=86_400), IS_NUMBER] = Field(
        120.0,
        description="Most processor time for one trajectory; when it is reached, the result "
        "depends on the computer.",
    )
    torque_percent: Annotated[float, Field(gt=0, le=100), IS_NUMBER] = Field(
        80.0,
        description="Share of the arm's torque limits that the nominal rigid body with its "
        "heaviest load may need; the rest is left to friction and control.",
    )
    max_jerk_deg_s3: Positive | None = Field(
        None, description="Fastest change of acceleration inside a trajectory; by default no limit."
    )
    clearance_mm: NonNegative | None = Field(
        None,
        description="Distance kept to table, walls and the arm itself; at least the station's "
        "`clearance_m`, which is the default.",
    )
    seed: Seed | None = Field(
        None, description="Decides where the search starts; by default `excitation.seed`."
    )


def _written_short(value: Any) -> Any:
    return {True: {}, False: None}[value] if isinstance(value, bool) else value


OptionalOptimise = Annotated[
    Optimise | None,
    BeforeValidator(_written_short, json_schema_input_type=Optimise | bool | None),
]
