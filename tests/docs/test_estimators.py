"""The page about estimators names every parameter with its default."""

from __future__ import annotations

import inspect
import re
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

from hil.core import plugins
from hil.core.yaml import scalar
from hil.data.filters import FilterSettings
from hil.data.splits import SAMPLE_SPLIT_PROTOCOL
from hil.estimators import estimator, load_model_file
from hil.estimators.base import GROUP, HONEST
from hil.estimators.static_model import PAPER_PROTOCOL
from hil.networks.lagrangian_settings import LAGRANGIAN_CHOICES as OURS_LAGRANGIAN
from hil.networks.residual_data import TRAINING, ResidualSettings
from tests.support.paths import DOCS
from tests.support.synthetic_motion import moving, nominal

PAGE = (DOCS / "reference" / "estimators.md").read_text("utf-8")
OURS = [name for name in plugins.names(GROUP) if plugins.load(GROUP, name).__module__[:4] == "hil."]


def defaults_on_page(title: str) -> dict[str, str]:
    assert f"\n{title}\n" in PAGE, f"docs/reference/estimators.md has no section {title!r}"
    section = re.split(r"\n#", PAGE.split(f"\n{title}\n")[1])[0]
    rows = re.findall(r"^\| `(\w+)` \| (.+?) \| .{10}", section, re.MULTILINE)
    return {name: default.strip("`") for name, default in rows}


def as_shown(default: Any) -> Any:
    return default if default is not None else "none"


def as_listed(default: Any) -> Any:
    """As YAML reads it, which has no tuples."""
    return list(default) if isinstance(default, tuple) else default


def test_our_estimators_are_registered() -> None:
    assert {"static-wls", "rigid-wls"} <= set(OURS)


@pytest.mark.parametrize("name", OURS)
def test_every_parameter_of_an_estimator_has_a_row_with_its_default(name: str) -> None:
    parameters = inspect.signature(plugins.load(GROUP, name)).parameters
    shown = defaults_on_page(f"## `{name}`")
    assert list(shown) == list(parameters)
    for key, parameter in parameters.items():
        if parameter.default is not None:
            assert scalar(shown[key]) == as_listed(parameter.default)


def test_every_filter_setting_has_a_row_with_its_default() -> None:
    shown = defaults_on_page("### `filters`")
    fields = {name: as_shown(field.default) for name, field in FilterSettings.model_fields.items()}
    assert {name: scalar(text) for name, text in shown.items()} == fields


def test_protocol_labels_are_those_of_the_models() -> None:
    section = PAGE.split("\n## Protocols")[1]
    assert re.findall(r"^\| `(.+?)` \|", section, re.MULTILINE) == [
        HONEST,
        PAPER_PROTOCOL,
        SAMPLE_SPLIT_PROTOCOL,
        ResidualSettings(inputs="history").protocol,
        ResidualSettings(inputs="measured").protocol,
    ]


@pytest.mark.parametrize(
    ("name", "used"), [("lagrangian", OURS_LAGRANGIAN), ("residual", TRAINING)]
)
def test_the_training_of_a_network_is_told_as_it_is(name: str, used: dict[str, Any]) -> None:
    row = re.split(r"\n## ", PAGE.split(f"\n## `{name}`\n")[1])[0].partition("| `training` |")[2]
    told = re.search(r"(\d+) epochs with the loss `(\w+)`", row)
    assert told is not None
    assert (int(told[1]), told[2]) == (used["epochs"], used["loss"])


def test_parameters_shown_in_the_example_are_accepted() -> None:
    made = estimator("rigid-wls", sign_width=0.02, filters={"velocity": 0.1})
    assert made.get_params()["filters"].velocity == 0.1


def test_the_example_of_an_estimator_fits_and_its_model_file_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (DOCS / "how-to" / "add-an-estimator.md").read_text("utf-8")
    (source,) = re.findall(r"```python\n(.+?)```", page, re.DOTALL)
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package" / "method.py").write_text(source, "utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    ((name, target),) = re.findall(r'^(my-\w+) = "(.+)"$', page, re.MULTILINE)
    monkeypatch.setattr(plugins, "entry_points", lambda *, group: [EntryPoint(name, target, group)])
    data = moving(1, 2, 3)

    fitted = estimator(name, widening=2.0).fit(data, nominal())
    read = load_model_file(fitted.save(tmp_path / "model"))

    assert read.get_params() == fitted.get_params()
    assert (read.predict(data).effort == fitted.predict(data).effort).all()
    for module in ("my_package", "my_package.method"):
        sys.modules.pop(module)
