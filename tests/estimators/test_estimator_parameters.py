"""Declared parameters of estimators and studies: who reads them."""

from __future__ import annotations

import pytest

from hil.estimators.parameters import Parametrised, number, parameter


class Own(Parametrised):
    """Has a constructor of its own."""

    def __init__(self, *, width: float = 1.0) -> None:
        self.width = width


def test_parameters_beside_a_constructor_are_refused_when_the_class_is_made() -> None:
    told = r"Both declares gain, bias .* constructor .*Both\.__init__ ignores: remove .* keywords"
    with pytest.raises(TypeError, match=told):

        class Both(Parametrised):
            gain: float = parameter(2.0, number, doc="Of the loop.")
            bias: float = parameter(0.0, number, doc="Of the sensor.")

            def __init__(self, *, width: float = 1.0) -> None:
                self.width = width


def test_parameters_beside_an_inherited_constructor_are_refused_too() -> None:
    with pytest.raises(TypeError, match=r"Wider declares gain .* constructor Own\.__init__"):

        class Wider(Own):
            gain: float = parameter(2.0, number, doc="Of the loop.")


def test_parameters_of_a_mixin_beside_a_constructor_are_refused_too() -> None:
    class Gain:
        gain: float = parameter(2.0, number, doc="Of the loop.")

    with pytest.raises(TypeError, match=r"Mixed declares gain .* constructor .*Mixed\.__init__"):

        class Mixed(Gain, Parametrised):
            def __init__(self, *, width: float = 1.0) -> None:
                self.width = width


def test_a_constructor_of_its_own_may_fix_parameters_of_a_base() -> None:
    class Declared(Parametrised):
        gain: float = parameter(2.0, number, doc="Of the loop.")

    class Fixed(Declared):
        def __init__(self, *, width: float = 1.0) -> None:
            super().__init__(gain=5.0)
            self.width = width

    assert (Fixed().gain, Fixed(width=3.0).get_params()) == (5.0, {"width": 3.0})
