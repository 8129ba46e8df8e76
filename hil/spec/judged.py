"""What a spec says about judging: what is held out, under what, and what is good enough."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from hil.spec.field_types import IS_NUMBER, Count, NonNegative, Positive, Seed, Strict, mistake


class HoldOut(Strict):
    """What is kept away from the fit and judged on, always whole poses, trajectories or loads."""

    trajectories: Count | None = Field(
        None,
        description="How many of the last trajectories; by default a quarter of them and at least "
        "one, or none when `loads` is given.",
    )
    trajectories_percent: Annotated[float, Field(ge=0, le=90), IS_NUMBER] | None = Field(
        None,
        description="Share of the trajectories, drawn by seed, in place of `trajectories`; at "
        "least one is held out and one left to fit on, with every load.",
    )
    poses_percent: Annotated[float, Field(ge=0, le=90), IS_NUMBER] | None = Field(
        None,
        description="Share of the poses, drawn by seed, both approaches together; by default 20, "
        "or none when `loads` is given.",
    )
    loads: tuple[Count, ...] = Field(
        (),
        description="Indices into `loads`, from 0. With `trajectories`, `trajectories_percent` or "
        "`poses_percent` beside it, the model is judged on motions *and* loads it has not seen, "
        "together.",
    )
    seed: Seed = Field(7, description="Decides which poses or trajectories are drawn.")

    @model_validator(mode="after")
    def _trajectories_are_chosen_one_way(self) -> HoldOut:
        if self.trajectories is not None and self.trajectories_percent is not None:
            raise mistake(
                "`trajectories` chooses the last ones, this one draws: keep one of the two",
                "trajectories_percent",
            )
        return self

    def trajectories_of(self, total: int) -> int:
        """How many of `total` different trajectories are held out."""
        if self.trajectories is not None:
            return self.trajectories
        if self.trajectories_percent is not None:
            count = round(self.trajectories_percent / 100 * total)
            return max(1, min(count, total - 1)) if self.trajectories_percent else 0
        return 0 if self.loads else max(1, total // 4)

    def poses_of(self, total: int) -> int:
        """How many of `total` different poses are held out."""
        default = 0.0 if self.loads else 20.0
        percent = default if self.poses_percent is None else self.poses_percent
        return max(1, round(percent / 100 * total)) if percent else 0


class Validate(Strict):
    """How the fitted models are judged."""

    hold_out: HoldOut = Field(HoldOut(), description="What no estimator gets to see.")
    under_loads: bool = Field(
        False,
        description="Fit to the first load alone, and judge every model under the others as well: "
        "unaware of the load, told of it as declared, and as identified; declared loads are "
        "checked.",
    )


class RmseLimit(Strict):
    """Largest root-mean-square error accepted on the held-out data."""

    max: Positive = Field(description="The limit, in `unit`.")
    unit: Literal["A", "N·m", "Nm"] = Field(description="What the robot's effort is measured in.")
    per: Literal["joint", "mean"] = Field(
        "mean", description="Whether every joint must keep the limit, or their mean."
    )
    signal: Literal["raw", "filtered"] = Field(
        "raw", description="Whether the measured effort is low-pass filtered before comparing."
    )


class NrmseLimit(Strict):
    """Largest RMSE over the standard deviation of the signal."""

    max: Positive = Field(description="The limit, without unit (0.1 is 10 %).")
    per: Literal["joint", "mean"] = Field(
        "mean", description="Whether every joint must keep the limit, or their mean."
    )


class GapsLimit(Strict):
    """Largest share of missing samples."""

    max: NonNegative = Field(description="The limit, in percent of the samples expected.")


class LoadErrorLimit(Strict):
    """Largest error under a load that a model is told of, over its error with the first load."""

    max: Positive = Field(description="The limit, without unit; both are means over the joints.")
    told: Literal["declared", "calibrated"] = Field(
        "declared",
        description="What the model is told: the load as declared, or that and drive gains as the "
        "other loads tell them.",
    )
    of: Literal["every", "first"] = Field(
        "every",
        description="Whether every estimator must keep it, or the first of `fit`, with the others "
        "beside it for comparison.",
    )


class ContradictedLimit(Strict):
    """How many declared loads may be contradicted by those identified."""

    max: Count = Field(description="The limit; a load that cannot be identified counts.")


class Accept(Strict):
    """Criteria for the verdict; without any for models: `not judged`, or `rejected` by gaps."""

    rmse: RmseLimit | None = Field(None, description="On the held-out data, in the robot's unit.")
    nrmse: NrmseLimit | None = Field(None, description="On the held-out data, without unit.")
    gaps_percent: GapsLimit | None = Field(None, description="On the recording.")
    load_error_ratio: LoadErrorLimit | None = Field(
        None, description="Under any load that it is told of; with `validate.under_loads`."
    )
    contradicted_loads: ContradictedLimit | None = Field(
        None, description="Of those declared, by the first estimator; with `validate.under_loads`."
    )

    @property
    def under_loads(self) -> tuple[str, ...]:
        """Keys of the criteria that are about loads."""
        keys = ("load_error_ratio", "contradicted_loads")
        return tuple(key for key in keys if getattr(self, key) is not None)
