"""Plug-ins: names without imports, errors that say how to mend them."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from hil.core import plugins
from hil.core.errors import PluginError

DRIVERS = "hil.drivers"


def class_with_members(name: str, group: str, *body: str) -> str:
    """The source of a class with every member of the interface of its group."""
    members = (f"{member} = None" for member in plugins.MEMBERS[group])
    return f"class {name}:\n" + "".join(f"    {line}\n" for line in (*body, *members))


ARM = class_with_members("Arm", DRIVERS)


def offer(monkeypatch: pytest.MonkeyPatch, **targets: str) -> None:
    """Register drivers, and nothing else."""
    points = [EntryPoint(name.rstrip("_"), target, DRIVERS) for name, target in targets.items()]
    monkeypatch.setattr(
        plugins, "entry_points", lambda *, group: points if group == DRIVERS else []
    )


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module that is not imported yet."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "lab_driver", raising=False)
    return tmp_path / "lab_driver.py"


def test_names_import_nothing(monkeypatch: pytest.MonkeyPatch, module: Path) -> None:
    module.write_text("raise RuntimeError('imported')")
    offer(monkeypatch, lab="lab_driver:Arm", b="x:y")

    assert plugins.names(DRIVERS) == ("b", "lab")
    assert "lab_driver" not in sys.modules


def test_load_gives_what_the_entry_point_names(
    monkeypatch: pytest.MonkeyPatch, module: Path
) -> None:
    module.write_text(ARM)
    offer(monkeypatch, lab="lab_driver:Arm")

    assert plugins.load(DRIVERS, "lab").__name__ == "Arm"


def test_an_unknown_name_is_guessed(monkeypatch: pytest.MonkeyPatch) -> None:
    offer(monkeypatch, mock="a:b", lab="c:d")

    with pytest.raises(PluginError, match="there is no robot driver called 'mok'") as caught:
        plugins.load(DRIVERS, "mok")
    assert caught.value.hint == "did you mean 'mock'?"
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    ("source", "message", "hint"),
    [
        (
            "import rtde_control_that_is_missing",
            "No module named 'rtde_control_that_is_missing'",
            "the module 'rtde_control_that_is_missing' is missing: "
            "install the package that contains it",
        ),
        (
            "raise ModuleNotFoundError(\"No module named 'torch.nn'\", name='torch.nn')",
            "ModuleNotFoundError: No module named 'torch.nn'",
            'pip install "hil[learn]"',
        ),
        (
            "try:\n    raise ModuleNotFoundError('x', name='mujoco')\n"
            "except ImportError as error:\n    raise RuntimeError('no physics') from error",
            "RuntimeError: no physics",
            'pip install "hil[mock]"',
        ),
        ("1 / 0", "ZeroDivisionError", "`hil doctor` shows all plug-ins"),
        ("import sys\nsys.exit(3)", "SystemExit: 3", "repair or uninstall"),
        ("x = 1", "AttributeError", "repair or uninstall"),
    ],
)
def test_a_broken_plugin_says_why_and_what_to_install(
    monkeypatch: pytest.MonkeyPatch, module: Path, source: str, message: str, hint: str
) -> None:
    module.write_text(source)
    offer(monkeypatch, lab="lab_driver:Arm")

    with pytest.raises(PluginError) as caught:
        plugins.load(DRIVERS, "lab")

    assert "the robot driver 'lab' (lab_driver:Arm) does not load" in caught.value.message
    assert message in caught.value.message
    assert hint in caught.value.hint
    assert caught.value.__cause__ is not None


@pytest.mark.parametrize(("body", "name"), [("pass", "''"), ("estimator = 'other'", "'other'")])
def test_an_estimator_must_have_the_name_of_its_entry_point(
    monkeypatch: pytest.MonkeyPatch, module: Path, body: str, name: str
) -> None:
    module.write_text(class_with_members("MyMethod", "hil.estimators", body))
    point = EntryPoint("my-method", "lab_driver:MyMethod", "hil.estimators")
    monkeypatch.setattr(plugins, "entry_points", lambda *, group: [point])

    with pytest.raises(PluginError) as caught:
        plugins.load("hil.estimators", "my-method")
    expected = f"MyMethod.estimator is {name}, but its entry point is called 'my-method'"
    assert caught.value.message == expected
    assert caught.value.hint == 'set estimator = "my-method" in the class'


def test_missing_members_are_named(monkeypatch: pytest.MonkeyPatch, module: Path) -> None:
    module.write_text(ARM.replace("    stop = None\n", "").replace("    read = None\n", ""))
    offer(monkeypatch, lab="lab_driver:Arm")

    with pytest.raises(PluginError, match=r"'lab' \(lab_driver:Arm\) lacks read, stop") as caught:
        plugins.load(DRIVERS, "lab")
    assert "add these members to Arm" in str(caught.value.hint)


def test_extras_that_are_no_mapping_are_named() -> None:
    class Estimator:
        def extras(self) -> None: ...

    with pytest.raises(PluginError, match=r"Estimator.*: extras\(\) returns None"):
        plugins.require_installed([("mine", Estimator())])


def test_a_name_claimed_twice_is_nobodys(monkeypatch: pytest.MonkeyPatch) -> None:
    offer(monkeypatch, lab="a:b", lab_="c:d")

    with pytest.raises(PluginError, match=r"is registered by .*\(a:b\) and .*\(c:d\)"):
        plugins.load(DRIVERS, "lab")


def test_describing_all_never_raises_and_tells_the_good_from_the_broken(
    monkeypatch: pytest.MonkeyPatch, module: Path
) -> None:
    module.write_text(ARM)
    offer(monkeypatch, good="lab_driver:Arm", bad="no_such_module:Arm")

    bad, good = plugins.describe_all()

    assert (good.group, good.name, good.target, good.error) == (
        DRIVERS,
        "good",
        "lab_driver:Arm",
        "",
    )
    assert "No module named 'no_such_module'" in bad.error
    assert bad.hint


def test_describing_without_trying_imports_nothing(
    monkeypatch: pytest.MonkeyPatch, module: Path
) -> None:
    module.write_text("raise RuntimeError('imported')")
    offer(monkeypatch, lab="lab_driver:Arm")

    assert [info.error for info in plugins.describe_all(try_loading=False)] == [""]


def test_this_distribution_registers_its_own_plugins() -> None:
    assert "mock" in plugins.names("hil.drivers")
    assert {"static-wls", "rigid-wls"} <= set(plugins.names("hil.estimators"))
    (static,) = [
        info for info in plugins.describe_all(try_loading=False) if info.name == "static-wls"
    ]
    assert static.distribution.startswith("hil ")


def test_a_package_installed_meanwhile_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Entry points are read again when a folder on the path has changed."""
    monkeypatch.syspath_prepend(tmp_path)
    for number in (1, 2):
        info = tmp_path / f"added_{number}-1.dist-info"
        draft = tmp_path.parent / f"draft-{number}"
        draft.mkdir()
        (draft / "METADATA").write_text(f"Name: added-{number}\nVersion: 1\n", "utf-8")
        (draft / "entry_points.txt").write_text(f"[hil.studies]\nadded-{number} = a:b\n", "utf-8")
        assert f"added-{number}" not in plugins.names("hil.studies")
        draft.rename(info)
        assert f"added-{number}" in plugins.names("hil.studies")
