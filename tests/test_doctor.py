"""What `hil doctor` says about torch."""

from __future__ import annotations

import sys
from importlib.metadata import PackageNotFoundError
from types import SimpleNamespace

import pytest

from hil import doctor
from hil.doctor import Finding


def test_doctor_tells_what_networks_are_trained_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def told(version: str | None, torch: object) -> list[Finding]:
        def asked(name: str) -> str:
            if version is None:
                raise PackageNotFoundError(name)
            return version

        monkeypatch.setattr(doctor.importlib.metadata, "version", asked)
        monkeypatch.setitem(sys.modules, "torch", torch)
        return list(doctor._torch())

    gpu = SimpleNamespace(
        cuda=SimpleNamespace(device_count=lambda: 1, get_device_name=lambda i: f"GPU {i}")
    )
    assert told(None, None) == []
    assert told("2.13.0+cpu", None) == [
        Finding("torch", "2.13.0+cpu: networks are trained on the CPU")
    ]
    assert told("2.13.0", gpu) == [Finding("torch", "2.13.0: networks are trained on GPU 0")]
    (broken,) = told("2.13.0", None)
    assert (broken.level, "cannot be used" in broken.finding) == ("note", True)
