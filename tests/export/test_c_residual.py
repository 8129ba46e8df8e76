"""Residual networks on physics, as one program in C."""

from __future__ import annotations

import pytest

from tests.support.residual_models import known, model, unfitted
from tests.support.synthetic_motion import nominal

pytest.importorskip("torch", reason="torch is not installed")

from hil.core.errors import FitError
from hil.export.c import export_c
from hil.export.c_compiler import compiler
from hil.export.program import program_of

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")


@pytest.mark.thorough
def test_physics_and_networks_say_together_what_the_model_says(tmp_path) -> None:
    told = export_c(model(), tmp_path / "out", prefix="arm")
    assert float(told.checked.split()[3]) < 1e-5
    assert "arm_network" in (told.out / "arm.c").read_text("utf-8")
    assert told.parts == "residual, with memory"


@pytest.mark.thorough
def test_a_network_that_every_joint_dropped_is_not_written(tmp_path) -> None:
    dropped = unfitted(base={"estimator": "rigid-wls"}, margin=0.99).fit(known(), nominal())
    assert not dropped.correction_.kept.any()
    told = export_c(dropped, tmp_path / "out")
    assert "hil_network" not in (told.out / "hil.c").read_text("utf-8")
    assert float(told.checked.split()[3]) < 1e-12


@pytest.mark.thorough
def test_a_network_that_hears_the_torque_it_predicts_is_refused() -> None:
    hearing = unfitted(base={"estimator": "rigid-wls"}, inputs="measured", margin=0.0)
    with pytest.raises(FitError, match="needs the torque that a controller wants predicted"):
        program_of(hearing.fit(known(), nominal()))
