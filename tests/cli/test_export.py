"""`hil export` at the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import HilError, RecordingError, SpecError
from hil.estimators import estimator, save_model
from hil.export.c_compiler import compiler
from tests.support.synthetic_motion import moving, nominal

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    fitted = estimator("rigid-wls").fit(moving(1, 2, 3), nominal())
    return save_model(fitted, tmp_path_factory.mktemp("models") / "model")


@pytest.mark.thorough
def test_a_model_becomes_a_folder_of_c(model: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["export", str(model), "-o", str(tmp_path / "c")])
    assert done.exit_code == 0, done.output
    assert "hil.h, hil.c, hil_test.c, CMakeLists.txt" in done.stdout
    assert "self-test: largest difference" in done.stdout
    assert (tmp_path / "c" / "hil.c").is_file()


@pytest.mark.thorough
def test_json_says_what_was_written(model: Path, tmp_path: Path) -> None:
    command = ["export", str(model), "-o", str(tmp_path / "c"), "--prefix", "arm", "--json"]
    done = CliRunner().invoke(app, command)
    told = json.loads(done.stdout)
    assert told["to"] == "c"
    assert told["files"] == ["arm.h", "arm.c", "arm_test.c", "CMakeLists.txt"]
    assert told["effort_unit"] == "A"


@pytest.mark.parametrize(
    ("more", "kind", "words"),
    [
        (["--to", "simulink"], SpecError, "unknown format --to 'simulink'"),
        (["--to", "urdf", "--prefix", "arm"], SpecError, "has no option --prefix"),
        (["--prefix", "2nd"], SpecError, "cannot be the prefix"),
        (["-o", "."], RecordingError, "exists already"),
    ],
)
def test_slips_are_one_error(
    more: list[str], kind: type[HilError], words: str, model: Path, tmp_path: Path
) -> None:
    done = CliRunner().invoke(app, ["export", str(model), "-o", str(tmp_path / "c"), *more])
    assert isinstance(done.exception, kind)
    assert words in done.exception.message
    assert not (tmp_path / "c").exists()
