"""What a spec may ask the arm to do while it is measured."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from hil.spec.field_types import IS_NUMBER, JointRange, Positive, Seed, Strict, mistake
from hil.spec.optimise import OptionalOptimise

LONGEST_TRAJECTORY_S = 3600.0
"""All set-points of one trajectory are in memory together."""


class Dwell(Strict):
    """A dwell program: go to many poses, stand still, measure."""

    kind: Literal["dwell"] = Field(description="Chooses the dwell program.")
    waypoints: Annotated[int, Field(ge=1, le=100_000), IS_NUMBER] = Field(
        650, description="How many poses, well spread over the joint ranges."
    )
    file: str | None = Field(
        None,
        description="CSV file of poses, one per row, one column per joint. An optional first line "
        "names the joints (or `q1` to `q6`), all with `_deg`, all with `_rad`, or all without "
        "either. A relative path starts at the folder of the spec. `waypoints` has no effect then.",
    )
    file_unit: Literal["deg", "rad"] = Field(
        "deg",
        description="Unit of the poses in `file`; not needed if the first line states it. If "
        "neither states it and no angle is beyond 2π, the file is refused.",
    )
    dwell_s: Annotated[float, Field(ge=0.01, le=600), IS_NUMBER] = Field(
        0.095, description="Shortest time at rest before the pose is left."
    )
    samples_per_dwell: Annotated[int, Field(ge=2, le=10_000), IS_NUMBER] = Field(
        10, description="Settled samples taken at every pose."
    )
    settle_rad_s: Positive = Field(
        0.002, description="All joints slower than this over the samples means settled."
    )
    settle_timeout_s: Annotated[float, Field(gt=0, le=600), IS_NUMBER] = Field(
        3.0, description="After this the pose is marked as not settled and left."
    )
    seed: Seed = Field(7, description="Decides which poses are drawn, and their order.")
    max_velocity_deg_s: Positive = Field(60.0, description="Fastest any joint moves.")
    max_acceleration_deg_s2: Positive = Field(80.0, description="Hardest any joint accelerates.")
    max_jerk_deg_s3: Positive = Field(800.0, description="Fastest change of acceleration.")
    approach: Literal["both", "positive", "negative", "free"] = Field(
        "both",
        description="`both` dwells at every pose twice, arriving from below and from above in "
        "every joint; `free` arrives as the way there happens to end.",
    )
    approach_deg: Positive = Field(3.0, description="How far the last stretch to a pose is.")
    range_deg: tuple[JointRange, ...] | None = Field(
        None,
        description="Joint ranges poses are drawn from, one pair per joint; by default those of "
        "the arm.",
    )

    @property
    def stated_unit(self) -> Literal["deg", "rad"] | None:
        """Unit of the poses in `file` if the spec states it."""
        return self.file_unit if "file_unit" in self.model_fields_set else None


class Fourier(Strict):
    """Finite Fourier series per joint (PINN paper eq. 29), at rest at both ends."""

    kind: Literal["fourier"] = Field(description="Chooses Fourier trajectories.")
    harmonics: Annotated[int, Field(ge=2, le=50), IS_NUMBER] = Field(
        5, description="Order of the series: so many sines and cosines per joint."
    )
    fundamental_hz: Annotated[float, Field(ge=0.001, le=10), IS_NUMBER] = Field(
        0.1, description="Frequency of the first harmonic; its inverse is the period."
    )
    periods: Annotated[int, Field(ge=1, le=1000), IS_NUMBER] = Field(
        1, description="How often each trajectory is repeated without a break."
    )
    trajectories: Annotated[int, Field(ge=1, le=1000), IS_NUMBER] = Field(
        12, description="How many different trajectories, each from rest to rest."
    )
    seed: Seed = Field(7, description="Decides which trajectories are drawn.")
    max_velocity_deg_s: Positive = Field(100.0, description="Fastest any joint moves.")
    max_acceleration_deg_s2: Positive = Field(300.0, description="Hardest any joint accelerates.")
    max_jerk_deg_s3: Positive = Field(
        2000.0, description="For the moves between trajectories, not inside them."
    )
    amplitude_deg: Positive = Field(
        90.0,
        description="Largest excursion from the centre of trajectories that are drawn; optimised "
        "ones only keep to `range_deg`.",
    )
    range_deg: tuple[JointRange, ...] | None = Field(
        None,
        description="Joint ranges the trajectories stay in, one pair per joint; by default those "
        "of the arm.",
    )
    optimise: OptionalOptimise = Field(
        None,
        description="How the trajectories are optimised; `true` takes the defaults, and without "
        "it the best of a few random draws is taken.",
    )

    @model_validator(mode="after")
    def _a_trajectory_ends(self) -> Fourier:
        lasts = self.periods / self.fundamental_hz
        if lasts > LONGEST_TRAJECTORY_S:
            message = (
                f"a trajectory of {self.periods} periods of {1 / self.fundamental_hz:g} s lasts "
                f"{lasts:g} s, longer than {LONGEST_TRAJECTORY_S:g} s: use more trajectories"
            )
            raise mistake(message, "periods")
        return self

    @model_validator(mode="after")
    def _amplitudes_are_of_random_draws(self) -> Fourier:
        if self.optimise is not None and "amplitude_deg" in self.model_fields_set:
            raise mistake(
                "has no effect on optimised trajectories: give range_deg instead", "amplitude_deg"
            )
        return self


Excitation = Annotated[Dwell | Fourier, Field(discriminator="kind")]
