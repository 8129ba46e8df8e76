"""The example projects' own CI passes against the wheel of this checkout: `make example`."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

from tests.support.paths import ROOT

pytestmark = pytest.mark.proof

TESTS_OF_EXAMPLES = 4


def test_the_examples_pass_against_the_built_wheel() -> None:
    done = subprocess.run(
        [ROOT / "examples" / "against-the-wheel.sh"],
        env={**os.environ, "PYTHON": sys.executable},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    print(done.stdout)  # noqa: T201
    assert done.returncode == 0
    assert re.search(rf"=+ {TESTS_OF_EXAMPLES} passed in ", done.stdout)
    assert "all that the checkout has" in done.stdout
