"""Models: fitted to recordings, judged on others, and asked for a load."""

from __future__ import annotations

from collections.abc import Iterable
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.api.arguments import AnyPath, AnyPayload, mapping, path, paths, payload_of, sources_of
from hil.core.errors import SpecError

if TYPE_CHECKING:
    from hil.estimators.payload_estimate import PayloadEstimate
    from hil.evaluation.fitting import FitReport
    from hil.networks.training_loop.problem import Watch


def fit(
    sources: AnyPath | Iterable[AnyPath],
    *,
    estimator: str,
    robot: str | None = None,
    payload: AnyPayload | None = None,
    gains: AnyPath | None = None,
    validate: AnyPath | Iterable[AnyPath] = (),
    parameters: dict[str, Any] | None = None,
    out: AnyPath = "models",
    page: AnyPath | None = None,
    checkpoints: AnyPath | None = None,
    watch: Watch | None = None,
) -> FitReport:
    """Fit an estimator to recordings and judge it on others.

    Args:
        sources: Run directories or MCAP files to fit on, or just one.
        estimator: Name in `hil.estimators`.
        robot: Built-in arm or URDF; by default what the data says.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a `Payload`; 0 for nothing
            mounted; by default what the data says.
        gains: File with `drive_gains_nm_a`; by default what the data says.
        validate: Held-out sources, or just one.
        parameters: The estimator's own parameters.
        out: Folder in which the model's folder is made.
        page: Also write an HTML report about the held-out sources here.
        checkpoints: Folder in which estimators that train networks keep their training, and from
            which they take it up again.
        watch: Told every epoch of such a training.
    """
    from hil.estimators.gains_file import read_gains
    from hil.evaluation.fitting import fit_sources

    held_out, given = paths(validate), mapping(parameters, "parameters", "{'weighted': True}")
    if taken := sorted(given.keys() & signature(fit_sources).parameters.keys()):
        raise SpecError(
            f"{taken[0]} is no parameter of an estimator", hint=f"hil.fit(…, {taken[0]}=…)"
        )
    if page is not None and not held_out:
        raise SpecError(
            "a page shows how a model does on held-out recordings, and none was given",
            hint="name one: hil.fit(…, validate=…)",
        )
    result = fit_sources(
        sources_of(sources),
        estimator=estimator,
        robot=robot,
        payload=payload_of(payload),
        gains=read_gains(path(gains)) if gains else None,
        validate=held_out,
        out=path(out),
        watch=watch,
        checkpoints=None if checkpoints is None else path(checkpoints),
        **given,
    )
    if page is not None:
        _fit_page(result, held_out, path(page))
    return result


def _fit_page(result: FitReport, held_out: Iterable[Path], page: Path) -> None:
    from hil.evaluation.fitting import usable_part
    from hil.importers.load import load_source
    from hil.report import render_fit_report

    model = result.fitted.model
    data = {str(source): usable_part(load_source(source), model) for source in held_out}
    render_fit_report(result.fitted.folder, data, page)


def evaluate(model: AnyPath, sources: AnyPath | Iterable[AnyPath]) -> list[dict[str, Any]]:
    """Judge a saved model; one entry per source, with the keys of `FitReport.to_dict`.

    Raises:
        DataError: A source cannot be read, or was among the model's training data.
    """
    from hil.evaluation.fitting import evaluate_sources

    return evaluate_sources(path(model), sources_of(sources))


def estimate_payload(
    model: AnyPath,
    sources: AnyPath | Iterable[AnyPath],
    *,
    friction: str = "auto",
    bare: AnyPath | Iterable[AnyPath] = (),
    gain_share: float | None = None,
) -> PayloadEstimate:
    """The load that was mounted in recordings, by a saved model of the arm.

    A recording of an arm at rest tells mass and centre of mass, one of motion inertia as well.

    Args:
        model: Its folder.
        sources: Run directories or MCAP files recorded with that load, or just one.
        friction: What of the model's friction may differ on that day: nothing (`model`), an
            `offset` per joint, or an offset and a factor (`scale`); `auto` lets the recording
            choose, by stretches that are left out in turn. At rest it is `auto`.
        bare: At rest: the same program run with nothing mounted, nor declared; much smaller errors.
        gain_share: Standard deviation of a drive gain, as a share of it, for the errors; by default
            0.05, or 0.01 where they were calibrated (`hil gains`); torques have none.

    Raises:
        DataError: A source cannot be read, is of another robot, or was fitted to.
        FitError: The recording does not tell the load.
        SpecError: There is no such way to treat friction, or `bare` was given with motion.
    """
    from typing import cast

    from hil.evaluation.load_fit import payload_of_sources

    return payload_of_sources(
        path(model), paths(sources), cast("Any", friction),
        bare=paths(bare), gain_share=gain_share,
    )  # fmt: skip
