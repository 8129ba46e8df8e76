"""An arm of one's own whose description was changed: every verb that uses a run's arm refuses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

import hil
from hil.arms.description import _parsed
from hil.cli.app import app
from hil.core.errors import DataError
from tests.support.paths import FILES

URDF = FILES / "own_arm.urdf"
FEWER = {
    "excitation.trajectories": "3", "excitation.fundamental_hz": "0.2",
    "warm_up.duration_s": "1", "fit": "[{estimator: rigid-wls}]",
    "validate": "{hold_out: {trajectories: 1}}", "accept": "{gaps_percent: {max: 1}}",
}  # fmt: skip
TOLD = "has changed since"

ASKED = {
    "resume": "resume RUN",
    "replay": "replay RUN LOG",
    "fit": "fit RUN -e rigid-wls",
    "evaluate": "evaluate OLD RUN",
    "report": "report RUN",
    "drive-gains": "drive-gains RUN",
    "payload": "payload OLD RUN",
    "validate-loads": "validate-loads RUN --model OLD",
    "study": "study RUN -s inverse-dynamics",
    "drift": "drift own RUN",
    "rest-pose": "rest-pose MODEL",
    "export": "export MODEL -o out --to json",
    "simulate": "simulate MODEL -o out",
    "models register": "models register MODEL --name other",
    "models compare": "models compare own v2 RUN",
    "models promote": "models promote own v2 --on RUN",
    "fleet fit": "fleet fit RUN -e rigid-wls --workers 1 --out fleet",
}
"""Verbs that use the arm of a run or a model."""

NOT_ASKED = {
    "validate", "plan", "schema", "optimise", "run", "record", "new", "explain",  # arms as they are
    "robots", "mock", "doctor", "plugins", "bench", "serve", "import",  # no run
    "runs", "show", "prune", "watch", "pause", "stop", "answer", "recover",  # a run's documents
    "figures",  # of the page as it was written
    "export-data",  # rows as they were recorded
    "models list", "models show", "models rollback", "models log", "models check",
    "models repair",  # documents
    "fleet run", "fleet resume", "fleet drift", "fleet report",  # by what `resume` and `drift` use
    "schedule run", "schedule plan", "schedule show", "schedule hold", "schedule release",
    "schedule systemd", "schedule arm", "schedule simulate",
    "reidentify",  # by what `run` and `drift` use
}  # fmt: skip


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A run and a registered model of an arm whose description was changed afterwards."""
    home = tmp_path_factory.mktemp("lab")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(home)
        CliRunner().invoke(app, ["new", "own-urdf", "--urdf", str(URDF)], catch_exceptions=False)
        spec, station, arm = (Path(f"own_arm{part}.yaml") for part in ("", "-station", "-arm"))
        report = hil.run(hil.load(spec, station, overrides=FEWER))
        assert report.error is None
        report.run.rename("RUN")
        (model,) = Path("RUN/fit").iterdir()
        shutil.copytree(model, "MODEL")
        shutil.copytree(model, "OLD")
        document = json.loads(Path("OLD/model.json").read_text())
        del document["robot"]["model_sha256"]  # as models were stored before
        Path("OLD/model.json").write_text(json.dumps(document))
        for model in ("OLD", "MODEL"):
            CliRunner().invoke(app, f"models register {model} --name own".split())
        promote = ["models", "promote", "own", "v1", "--on", "RUN", "--unless-worse"]
        CliRunner().invoke(app, promote, catch_exceptions=False)
        arm.write_text(arm.read_text().replace("rate_hz: 250", "rate_hz: 251"))
        _parsed.cache_clear()
        yield home


def verbs(group: typer.Typer = app) -> set[str]:
    command = typer.main.get_command(group)
    named = getattr(command, "commands", {})
    return {
        f"{name} {below}" if below else name
        for name, one in named.items()
        for below in getattr(one, "commands", {"": one})
    }


def test_no_verb_is_forgotten() -> None:
    assert verbs() == ASKED.keys() | NOT_ASKED
    assert not ASKED.keys() & NOT_ASKED


@pytest.mark.thorough
@pytest.mark.parametrize("verb", ASKED)
def test_a_verb_that_uses_the_arm_asks_for_the_one_that_was_recorded(verb: str, lab: Path) -> None:
    done = CliRunner().invoke(app, ASKED[verb].split())
    said = f"{done.output} {done.exception}"
    assert done.exit_code, said
    assert TOLD in said


def test_so_does_the_api(lab: Path) -> None:
    for asked in (
        lambda: hil.dataset("RUN"),
        lambda: hil.fit("RUN", estimator="rigid-wls"),
        lambda: hil.evaluate("OLD", "RUN"),
        lambda: hil.estimate_payload("OLD", "RUN"),
        lambda: hil.resume("RUN"),
        lambda: hil.study("RUN", "inverse-dynamics"),
        lambda: hil.rest_poses("MODEL"),
    ):
        with pytest.raises(DataError, match=TOLD) as refused:
            asked()
        assert "restore the original file" in refused.value.hint
