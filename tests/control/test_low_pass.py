"""The low-pass in front of hand guiding."""

import numpy as np
import pytest

from hil.control.hand_guiding import LowPass
from hil.core.errors import SpecError


def gain(hz, cutoff=10.0, rate=1000.0):
    """Of a sine, once it has settled."""
    low, t = LowPass(cutoff, rate), np.arange(4000) / rate
    out = np.array([low(np.array([np.sin(2 * np.pi * hz * now)]))[0] for now in t])
    return np.abs(out[2000:]).max()


def test_what_is_slow_passes_and_what_is_fast_does_not() -> None:
    assert gain(0.5) == pytest.approx(1.0, abs=0.01)
    assert gain(10.0) == pytest.approx(np.sqrt(0.5), abs=0.03)
    assert gain(70.0) < 0.16


@pytest.mark.parametrize("cutoff", [0.0, 500.0, float("nan")])
def test_a_cutoff_that_cannot_be_is_refused(cutoff) -> None:
    with pytest.raises(SpecError, match="samples per second is invalid"):
        LowPass(cutoff, 1000.0)
