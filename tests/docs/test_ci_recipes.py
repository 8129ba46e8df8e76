"""The recipes of docs/how-to/run-in-ci.md: a spec that is wrong ends the job, good ones do not."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.support import docs_commands
from tests.support.paths import DOCS, EXPERIMENTS

SPEC = EXPERIMENTS / "ci_dwell_12.yaml"
GITHUB_JOB, GITLAB_JOB = (
    yaml.safe_load(block.text)
    for block in docs_commands.blocks(DOCS / "how-to" / "run-in-ci.md")
    if block.language == "yaml"
)
STEPS = GITHUB_JOB["jobs"]["mock"]["steps"]
GITHUB = "".join(f"{step['run']}\n" for step in STEPS if "run" in step)
GITLAB = "\n".join(GITLAB_JOB["mock"]["script"])
HIL = f"""#!/bin/sh
case "$1 $2" in
  validate*) exec {Path(sys.executable).parent}/hil "$@" ;;
  *unsafe*) exit 2 ;;
esac
"""
"""Only `validate` is the real one; a plan is safe unless the spec's name says otherwise."""


def ended(script: str, folder: Path) -> int:
    """Exit code of lines as a runner's shell takes them, with the specs of a folder."""
    shutil.copy(SPEC, folder / "specs" / "good.yaml")
    for name, text in (("hil", HIL), ("pip", "#!/bin/sh\n")):
        (folder / name).write_text(text, "utf-8")
        (folder / name).chmod(0o755)
    own = {key: value for key, value in os.environ.items() if not key.startswith("HIL_")}
    done = subprocess.run(
        ["bash", "-e", "-c", script],
        cwd=folder,
        env=own | {"PATH": f"{folder}{os.pathsep}{own['PATH']}"},
        capture_output=True,
        timeout=60,
    )
    return done.returncode


@pytest.mark.thorough
@pytest.mark.parametrize("script", [GITHUB, GITLAB], ids=["github", "gitlab"])
@pytest.mark.parametrize(
    ("name", "text", "code"),
    [
        ("b.yaml", SPEC.read_text("utf-8"), 0),
        ("b.yaml", "hil_experiment: 1\nname: b\nrobot: [\n", 2),
        ("z.yaml", "hil_experiment: 1\nname: z\n", 2),
        ("b-unsafe.yaml", SPEC.read_text("utf-8"), 2),
    ],
    ids=["good", "no YAML, first", "no spec, last", "no safe plan"],
)
def test_a_recipe_ends_with_the_first_spec_that_is_wrong(
    script: str, name: str, text: str, code: int, tmp_path: Path
) -> None:
    (tmp_path / "specs").mkdir()
    (tmp_path / "specs" / name).write_text(text, "utf-8")
    assert ended(script, tmp_path) == code
