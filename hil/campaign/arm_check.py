"""Can the robot do what the spec asks of it? Everything that it cannot, with its place."""

from __future__ import annotations

from hil.arms import is_described, load_arm
from hil.campaign.experiment import Experiment
from hil.errors import SpecError
from hil.plan.limits import excesses
from hil.robot import Capabilities
from hil.spec.judgeable import misjudged
from hil.spec.overrides import lay_over
from hil.spec.source import Mark, Problem, Source, refuse
from hil.spec.yaml_source import read_source


def require_within_reach(experiment: Experiment, robot: Capabilities) -> None:
    """Refuse what the arm's description and the driver's facts rule out, before a plan is tried.

    Args:
        experiment: What is asked.
        robot: What its driver says of itself; it need not be connected.

    Raises:
        SpecError: With a line `file:line:column: path: message` for every value that is beyond
            the arm, or in another unit than the robot measures.
    """
    spec, model = experiment.spec, experiment.robot.model
    found = misjudged(spec, robot.effort_kind)
    if is_described(model):
        found += excesses(spec, load_arm(model), robot.rate_hz)
    if not found:
        return
    source = _source_of(experiment)
    raise refuse(
        [Problem(source.mark(one.path), one.path, one.message) for one in found],
        hint="change these values, or take another robot",
    )


def _source_of(experiment: Experiment) -> Source:
    """The file with its overrides, for the places in it; a spec without one is named."""
    if experiment.spec_source:
        try:
            source = read_source(experiment.spec_source)
            lay_over(source, experiment.overrides)
        except SpecError:  # changed since it was loaded
            pass
        else:
            return source
    return Source(experiment.spec.name, values={(): Mark(experiment.spec.name, 0, 0)})
