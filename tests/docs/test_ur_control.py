"""The page on controlling the mock UR controller names every method that clients may call."""

import inspect
import re

import pytest

from tests.support.paths import DOCS

rtde_control = pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")

PAGE = DOCS / "reference" / "mock-ur-control.md"


def test_every_method_of_the_control_interface_is_listed():
    listed = set(re.findall(r"`(\w+)[(`]", PAGE.read_text("utf-8")))
    interface = rtde_control.RTDEControlInterface
    methods = {
        name
        for name, member in inspect.getmembers(interface, callable)
        if not name.startswith("_") and not inspect.isclass(member)
    }
    assert len(methods) > 50
    assert methods - listed == set()
