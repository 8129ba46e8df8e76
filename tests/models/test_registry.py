"""The registry: versions, comparisons, promotions, damage, and writers that are killed."""

from __future__ import annotations

import hashlib
import json
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core.errors import DataError, RegistryError, Rejected, SpecError, exit_code_of
from hil.data import Dataset
from hil.estimators import estimator
from hil.estimators.base import RobotEstimator
from hil.estimators.model_file import Training
from hil.models.log import (
    ALIASES_FILE,
    HEAD_FILE,
    LOG_FILE,
    Aliases,
    Entry,
    append,
    append_line,
    read_log,
)
from hil.models.model_registry import Registry, facts_of
from hil.models.promotion import BLOCK_S, Comparison, compare, fresh_part
from hil.models.version import folder_of, numbers_in
from tests.support.imported_motions import recording
from tests.support.paths import FILES
from tests.support.synthetic_motion import moving, nominal

# Versions never change, the log only grows, and there is always a way back


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three different models of one arm."""
    home = tmp_path_factory.mktemp("models")
    fits = [estimator("rigid-wls").fit(moving(1, 2, seed), nominal()) for seed in (3, 4, 5)]
    return [fit.save(home / str(k)) for k, fit in enumerate(fits)]


@pytest.fixture
def registry(tmp_path: Path, folders: list[Path]) -> Registry:
    made = Registry(tmp_path / "registry")
    for folder in folders:
        made.register("ur5", folder, {"estimator": "rigid-wls"})
    return made


@pytest.fixture
def fourth(tmp_path: Path) -> Path:
    """A model that is not registered yet."""
    return estimator("rigid-wls").fit(moving(1, 2, 6), nominal()).save(tmp_path / "fourth")


def promoted(registry: Registry, number: int) -> None:
    registry.promote(
        "ur5", number, reason="", evidence={}, instead_of=registry.aliases("ur5").champion
    )


def test_versions_are_numbered_and_say_what_they_are(registry, folders) -> None:
    assert [one.label for one in registry.versions("ur5")] == ["v1", "v2", "v3"]
    assert registry.names() == ["ur5"]
    data = moving(9)
    kept = registry.load("ur5", "v2").predict(data).effort
    fresh = estimator("rigid-wls").fit(moving(1, 2, 4), nominal()).predict(data).effort
    assert np.array_equal(kept, fresh)


def test_the_same_model_twice_is_one_version(registry, folders) -> None:
    assert registry.register("ur5", folders[1], {}).number == 2
    assert len(registry.versions("ur5")) == 3


def test_rolling_back_restores_predictions_bit_for_bit(registry) -> None:
    promoted(registry, 1)
    before = registry.load("ur5").predict(moving(9)).effort
    promoted(registry, 3)
    assert not np.array_equal(registry.load("ur5").predict(moving(9)).effort, before)
    assert registry.roll_back("ur5", reason="worse on the line").champion == 1
    assert np.array_equal(registry.load("ur5").predict(moving(9)).effort, before)


def test_going_back_twice_does_not_come_forward_again(registry) -> None:
    for number in (1, 2, 3):
        promoted(registry, number)
    assert registry.roll_back("ur5", reason="").champion == 2
    assert registry.roll_back("ur5", reason="").champion == 1
    with pytest.raises(RegistryError, match="previous champions: none"):
        registry.roll_back("ur5", reason="")
    promoted(registry, 3)
    assert registry.roll_back("ur5", reason="", to=1).champion == 1


def test_a_challenger_is_one_until_it_is_promoted_or_not(registry, folders) -> None:
    promoted(registry, 1)
    registry.register("ur5", folders[1], {}, challenger=True)
    assert registry.aliases("ur5").challenger == 2
    assert registry.version("ur5", "challenger").number == 2
    registry.keep("ur5", 2, reason="errs more", evidence={})
    assert registry.aliases("ur5").challenger == 0
    registry.register("ur5", folders[2], {}, challenger=True)
    promoted(registry, 3)
    assert registry.aliases("ur5").to_dict() == {"champion": 3, "challenger": None, "before": [1]}
    registry.register("ur5", folders[2], {}, challenger=True)
    assert registry.aliases("ur5").challenger == 0


def test_who_compared_with_another_champion_does_not_promote(registry) -> None:
    promoted(registry, 1)
    promoted(registry, 2)
    with pytest.raises(RegistryError, match="v2 has become champion meanwhile"):
        registry.promote("ur5", 3, reason="", evidence={}, instead_of=1)


def test_what_was_changed_is_not_loaded(registry) -> None:
    path = registry.version("ur5", "v1").folder / "model.json"
    path.chmod(0o644)
    path.write_text(path.read_text("utf-8").replace('"samples": ', '"samples": 1'), "utf-8")
    with pytest.raises(RegistryError, match=r"model\.json was changed after its registration"):
        registry.load("ur5", "v1")
    with pytest.raises(RegistryError, match="was changed after"):
        promoted(registry, 1)


def test_a_line_that_a_crash_has_torn_is_none(registry, tmp_path: Path) -> None:
    promoted(registry, 1)
    log = registry.root / "ur5" / LOG_FILE
    whole = log.read_bytes()
    log.write_bytes(whole + b'{"event": "promoted", "version": 2, "at"')
    assert registry.aliases("ur5").champion == 1
    promoted(registry, 3)
    assert log.read_bytes().startswith(whole)
    assert registry.aliases("ur5").champion == 3


def test_a_log_that_was_changed_is_found_out(registry) -> None:
    promoted(registry, 1)
    promoted(registry, 2)
    log = registry.root / "ur5" / LOG_FILE
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join(lines[:-2] + lines[-1:]))
    with pytest.raises(RegistryError, match=r"log.jsonl:4 does not follow the line before"):
        registry.aliases("ur5")
    log.write_bytes(b"".join([*lines[:-1], b"{}\n"]))
    with pytest.raises(RegistryError, match=r"log.jsonl:5: damaged"):
        registry.aliases("ur5")


def test_views_are_made_from_files(registry) -> None:
    promoted(registry, 2)
    home = registry.root / "ur5"
    (home / ALIASES_FILE).unlink()
    assert registry.rebuild("ur5").champion == 2
    assert json.loads((home / ALIASES_FILE).read_bytes())["champion"] == 2


def test_a_version_that_the_log_does_not_know_is_entered(registry, fourth: Path) -> None:
    """As after a crash between the folder and the line."""
    home = registry.root / "ur5"
    before = {name: (home / name).read_bytes() for name in (LOG_FILE, HEAD_FILE)}
    version = registry.register("ur5", fourth, {})
    for name, content in before.items():
        (home / name).write_bytes(content)
    promoted(registry, version.number)
    events = [(entry.event, entry.version) for entry in registry.log("ur5")]
    assert events[-2:] == [("registered", 4), ("promoted", 4)]


def test_many_writers_at_once_lose_nothing(registry, folders) -> None:
    def work(k: int) -> None:
        registry.register("lab", folders[k % 3], {}, challenger=True)
        registry.register(f"own-{k}", folders[k % 3], {})

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(6)))
    assert len(registry.versions("lab")) == 3
    assert sum(entry.event == "registered" for entry in registry.log("lab")) == 3
    assert len(registry.names()) == 8


def test_an_entry_comes_back_as_it_was(tmp_path: Path) -> None:
    entry = Entry("kept", 2, "2026-01-01T00:00:00+00:00", "a\nb", "é \u2028", {"x": [1.5, None]})
    append(tmp_path, entry)
    assert read_log(tmp_path) == (entry,)


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "x" * 70, "ur 5"])
def test_a_name_that_is_no_folder_is_refused(name: str, tmp_path: Path, folders) -> None:
    with pytest.raises(RegistryError, match="cannot be the name"):
        Registry(tmp_path).register(name, folders[0], {})


@pytest.mark.parametrize(
    ("which", "words"),
    [("champion", "no champion"), ("v7", "no version 7"), ("newest", "is not a version")],
)
def test_versions_that_are_not_there(which: str, words: str, registry) -> None:
    with pytest.raises(RegistryError, match=words):
        registry.version("ur5", which)


def test_slips_are_told(registry, tmp_path: Path) -> None:
    with pytest.raises(RegistryError) as error:
        registry.versions("ur6")
    assert (
        error.value.hint == "the registry has ur5: hil models list"
    )  # another number, another robot
    with pytest.raises(RegistryError) as error:
        registry.versions("urr5")
    assert error.value.hint == "did you mean 'ur5'?"
    with pytest.raises(DataError, match="is not a model folder"):
        registry.register("ur5", tmp_path, {})
    assert not folder_of(registry.root / "ur5", 4).exists()


# Who errs less, on the same data; chance is no reason


NOISE_A = 0.05
JOINTS = tuple(f"j{k + 1}" for k in range(6))


def fitted(data: Dataset) -> RobotEstimator:
    return estimator("rigid-wls").fit(data, nominal())


def rougher(data: Dataset, joint: int, amount_a: float) -> Dataset:
    """As after wear: one joint with more dry friction."""
    more = np.zeros_like(data["effort"])
    more[:, joint] = amount_a * np.tanh(data["qd"][:, joint] / 0.01)
    changed = {name: data[name] + more for name in ("effort", "effort_f")}
    return replace(data, columns=dict(data.columns) | changed)


@pytest.fixture(scope="module")
def champion() -> RobotEstimator:
    return fitted(moving(1, 2, 3, noise_a=NOISE_A))


def judged(
    ratio: np.ndarray,
    sure: int | None = None,
    difference: float = -0.2,
    interval: tuple[float, float] = (-0.3, -0.1),
) -> Comparison:
    """A comparison in which the challenger errs `ratio` times as much, in one joint for sure."""
    old = np.full(6, 0.1)
    return Comparison(
        "A", JOINTS, (), 1000, 20, old, old * ratio, difference, interval, np.arange(6) == sure
    )


@pytest.mark.parametrize(
    ("times", "sure", "spoilt"),
    [
        (1.04, 4, False),
        (1.06, None, False),
        (1.06, 4, True),
        (1.24, None, False),
        (1.26, None, True),
    ],
)
def test_a_joint_is_spoilt_if_it_errs_noticeably_more_for_sure_or_much_more(
    times: float, sure: int | None, spoilt: bool
) -> None:
    told = judged(np.array([1, 0.4, 1, 1, times, 1]), sure)
    assert told.better is not spoilt
    assert told.worse is spoilt
    assert ("the error of j5 is" in told.words) is spoilt


FRESH = (11, 12, 13, 14, 15, 16)


def test_after_wear_who_learned_of_it_errs_less(champion) -> None:
    challenger = fitted(rougher(moving(4, 5, 6, noise_a=NOISE_A), 1, 0.1))
    told = compare(champion, challenger, [rougher(moving(*FRESH, noise_a=NOISE_A), 1, 0.1)])
    assert told.better
    assert not told.worse
    assert told.ratio[1] < 0.6
    assert told.blocks == len(FRESH)
    assert told.words.startswith("the challenger's error is smaller: -")
    back = compare(challenger, champion, [moving(*FRESH, noise_a=NOISE_A)])
    assert back.better


def test_who_learned_too_little_errs_more(champion) -> None:
    few = fitted(moving(4, noise_a=8 * NOISE_A))
    told = compare(champion, few, [moving(*FRESH, noise_a=NOISE_A)])
    assert told.worse
    assert not told.better
    assert "error is larger" in told.words


@pytest.mark.thorough
def test_equals_are_rarely_told_apart() -> None:
    """Nobody of six who learned as much is sure to err less than all the others."""
    of = [fitted(moving(*range(100 + 3 * k, 103 + 3 * k), noise_a=NOISE_A)) for k in range(6)]
    data = [moving(*range(900, 912), noise_a=NOISE_A)]
    wins = [compare(old, new, data).better for old, new in pairwise([*of, of[0]])]
    assert sum(wins) <= 2


@pytest.mark.thorough
def test_a_joint_that_gets_clearly_worse_is_not_outweighed(champion) -> None:
    data = rougher(moving(4, 5, 6, noise_a=NOISE_A), 1, 0.3)
    challenger = fitted(rougher(data, 4, 0.02))
    told = compare(champion, challenger, [rougher(moving(*FRESH, noise_a=NOISE_A), 1, 0.3)])
    assert told.difference < 0
    assert told.worse
    assert not told.better
    assert told.words.startswith("the error of wrist_2_joint is ")
    assert told.surely_more.tolist() == [False] * 4 + [True, False]


def test_who_errs_a_little_more_everywhere_is_worse() -> None:
    """No joint by itself errs so much more that it would be turned down."""
    told = judged(1.02 * np.ones(6), difference=0.04, interval=(-0.01, 0.09))
    assert told.worse
    assert not told.better
    assert "error is larger" in told.words


def test_too_little_data_decide_nothing(champion) -> None:
    with pytest.raises(RegistryError, match=f"only 2 distinct blocks of {BLOCK_S:.0f} s"):
        compare(champion, champion, [moving(11, 12)])


@pytest.mark.thorough
def test_the_same_motion_driven_again_is_no_new_evidence(champion) -> None:
    """Only its noise is new: what a model gets wrong along it, it gets wrong again."""
    challenger = fitted(moving(4, 5, 6, noise_a=NOISE_A))
    again = [moving(*FRESH, noise_a=NOISE_A * k) for k in (1, 2)]
    once, twice = (compare(champion, challenger, again[:k]) for k in (1, 2))
    assert twice.blocks == once.blocks == len(FRESH)
    assert twice.samples == 2 * once.samples


def test_models_of_another_unit_are_not_compared(champion) -> None:
    other = fitted(moving(1, 2, 3, kind="torque"))
    with pytest.raises(RegistryError, match="effort kind: current and torque"):
        compare(champion, other, [moving(*FRESH)])


def test_of_a_run_that_was_learned_from_only_held_out_series_count() -> None:
    data = moving(1, 2, 3, 4, 5, noise_a=NOISE_A)
    learned = [model_of(data.take([0, 1, 2])), model_of(data.take([2, 3]))]
    assert [one.id for one in fresh_part(learned[:1], data).conditions] == [
        one.id for one in data.conditions[3:]
    ]
    assert len(fresh_part(learned, data).conditions) == 1


def model_of(data: Dataset) -> RobotEstimator:
    model = fitted(data)
    model.training_ = Training.of(data)
    return model


# From recordings to a champion and back, at the command line


TRAINED, FRESH_MOTIONS = (1, 2, 3), (11, 12, 13, 14)


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    folder = tmp_path_factory.mktemp("recordings")
    return {seed: recording(folder, seed) for seed in (*TRAINED, *FRESH_MOTIONS)}


@pytest.fixture(scope="module")
def good_and_poor(sources, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """`good` learned from three trajectories; `poor` takes viscous friction for nothing else."""
    out = tmp_path_factory.mktemp("models")
    told = {"good": {}, "poor": {"sign_width": 5.0}}
    return {
        name: hil.fit(
            [sources[k] for k in TRAINED], estimator="rigid-wls", out=out, parameters=how
        ).fitted.folder
        for name, how in told.items()
    }


@pytest.fixture
def promotable(good_and_poor, tmp_path: Path) -> Path:
    root = tmp_path / "registry"
    for name in ("poor", "good"):
        Registry(root).register("ur5", good_and_poor[name], facts_of(good_and_poor[name]))
    return root


def invoked(promotable: Path, *words: str | Path):
    arguments = ["models", *map(str, words), "--registry", str(promotable)]
    return CliRunner().invoke(app, arguments)


def on(sources) -> list[str]:
    return [word for seed in FRESH_MOTIONS for word in ("--on", str(sources[seed]))]


@pytest.mark.thorough
def test_the_better_is_promoted_and_the_way_back_is_there(promotable, sources) -> None:
    first = invoked(promotable, "promote", "ur5", "v1", *on(sources))
    assert "ur5: v1 is champion: there is no other champion" in first.stdout
    second = invoked(promotable, "promote", "ur5", "v2", *on(sources), "--reason", "weekly")
    assert second.exit_code == 0, second.output
    assert "ur5: v2 is champion: weekly: the challenger's error is smaller" in second.stdout
    assert "v1 is champion again" in invoked(promotable, "rollback", "ur5").stdout
    log = json.loads(invoked(promotable, "log", "ur5", "--json").stdout)["log"]
    assert [one["event"] for one in log][2:] == ["promoted", "promoted", "rolled-back"]
    assert log[3]["evidence"]["comparison"]["better"] is True


@pytest.mark.thorough
def test_the_worse_is_never_promoted(promotable, sources) -> None:
    invoked(promotable, "promote", "ur5", "v2", *on(sources))
    for more in ([], ["--unless-worse"]):
        done = invoked(promotable, "promote", "ur5", "v1", *on(sources), *more)
        assert isinstance(done.exception, Rejected)
        words = "v1 is not promoted, v2 stays champion: the challenger's error is larger"
        assert words in done.exception.message
    assert Registry(promotable).aliases("ur5").champion == 2
    assert Registry(promotable).log("ur5")[-1].event == "kept"


@pytest.mark.thorough
def test_criteria_are_met_or_there_is_no_promotion(promotable, sources) -> None:
    done = invoked(promotable, "promote", "ur5", "v2", *on(sources), "--max-rmse", "1e-9")
    assert isinstance(done.exception, Rejected)
    assert "criteria are not met: rmse_raw of mean is" in done.exception.message
    assert Registry(promotable).aliases("ur5").champion == 0


def test_nobody_is_judged_on_what_it_learned_from(promotable, sources) -> None:
    done = invoked(promotable, "promote", "ur5", "v2", "--on", sources[1])
    assert isinstance(done.exception, DataError)
    assert "training data of the model" in str(done.exception)
    unjudged = invoked(promotable, "promote", "ur5", "v2", "--max-rmse", "1")
    assert isinstance(unjudged.exception, SpecError)


@pytest.mark.thorough
def test_two_versions_side_by_side(promotable, sources) -> None:
    files = [sources[seed] for seed in FRESH_MOTIONS]
    done = invoked(promotable, "compare", "ur5", "v2", *files, "--with", "v1")
    assert done.exit_code == 0, done.output

    assert "the challenger's error is smaller" in done.stdout
    told = json.loads(
        invoked(promotable, "compare", "ur5", "v2", *files, "--with", "v1", "--json").stdout
    )
    assert np.all(np.array(told["challenger_rmse"]) <= told["champion_rmse"])
    assert told["samples"] == 4 * 1000


def test_a_comparison_without_a_champion_names_what_else_can_be_done(promotable, sources) -> None:
    done = invoked(promotable, "compare", "ur5", "v2", sources[FRESH_MOTIONS[0]])
    assert isinstance(done.exception, RegistryError)
    assert done.exception.message == "ur5 has no champion"
    assert "--with v2" in done.exception.hint
    assert "hil models promote ur5 v1" in done.exception.hint


@pytest.mark.thorough
def test_what_is_there_is_listed(promotable, good_and_poor) -> None:
    done = invoked(promotable, "register", good_and_poor["good"], "--name", "ur5", "--challenger")
    assert "ur5 v2: rigid-wls" in done.stdout
    listed = json.loads(invoked(promotable, "list", "--json").stdout)["models"]
    assert listed == [
        {
            "name": "ur5",
            "versions": 2,
            "champion": None,
            "challenger": 2,
            "before": [],
            "problem": None,
        }
    ]
    assert "challenger" in invoked(promotable, "show", "ur5").stdout
    shown = json.loads(invoked(promotable, "show", "ur5", "v1").stdout)
    assert shown["facts"]["trained_on"] == ["1.mcap", "2.mcap", "3.mcap"]
    assert shown["facts"]["joint_names"] == list(nominal().joint_names)
    assert "1 names, 2 versions" in invoked(promotable, "check").stdout


def test_an_empty_registry_says_how_to_begin(tmp_path: Path) -> None:
    assert "hil models register MODEL --name NAME" in invoked(tmp_path / "none", "list").stdout


# A log that was emptied, cut, edited or removed is found out, and only `repair` rewrites it


Damage = Callable[[Path], None]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, folders: list[Path]) -> Path:
    """v1 and v2, registered and promoted in turn: four lines, and v2 is champion."""
    registry = Registry(tmp_path_factory.mktemp("whole") / "registry")
    for folder in folders[:2]:
        number = registry.register("ur5", folder, {"estimator": "rigid-wls"}).number
        registry.promote("ur5", number, reason="", evidence={}, instead_of=number - 1)
    return registry.root


@pytest.fixture
def home(whole: Path, tmp_path: Path) -> Path:
    """The folder of `ur5` in a registry of its own."""
    return Path(shutil.copytree(whole, tmp_path / "registry")) / "ur5"


@pytest.fixture
def old_home(home: Path) -> Path:
    """The same as written before there was a head: no `head.json`, and lines without numbers."""
    documents = [json.loads(line) for line in lines_of(home)]
    (home / HEAD_FILE).unlink()
    (home / LOG_FILE).unlink()
    before = ""
    for document in documents:
        del document["line"]
        append_line(home / LOG_FILE, document | {"before": before})
        before = hashlib.sha256(lines_of(home)[-1].rstrip(b"\n")).hexdigest()
    return home


def lines_of(home: Path) -> list[bytes]:
    return (home / LOG_FILE).read_bytes().splitlines(keepends=True)


def keep_lines(count: int) -> Damage:
    """Cut the log after so many lines, or so many before its end."""
    return lambda home: void((home / LOG_FILE).write_bytes(b"".join(lines_of(home)[:count])))


def cut_inside_a_line(home: Path) -> None:
    content = (home / LOG_FILE).read_bytes()
    (home / LOG_FILE).write_bytes(content[:-20])


def edit_line(number: int) -> Damage:
    def edit(home: Path) -> None:
        lines = lines_of(home)
        lines[number] = lines[number].replace(b'"reason": ""', b'"reason": "x"')
        (home / LOG_FILE).write_bytes(b"".join(lines))

    return edit


def remove(*names: str) -> Damage:
    def unlink(home: Path) -> None:
        for name in names:
            (home / name).unlink()

    return unlink


def void(_: object) -> None:
    """Drop a value."""


def older_head(home: Path) -> None:
    """Put back the head of the first line, as from a backup."""
    first = hashlib.sha256(lines_of(home)[0].rstrip(b"\n")).hexdigest()
    head = json.loads((home / HEAD_FILE).read_bytes())
    head |= {"lines": 1, "sha256": first, "champion": None, "before": []}
    (home / HEAD_FILE).write_text(json.dumps(head))


def edit_head(home: Path) -> None:
    """Name the wrong champion, with number of lines and digest as they were."""
    head = json.loads((home / HEAD_FILE).read_bytes())
    (home / HEAD_FILE).write_text(json.dumps(head | {"champion": 1, "before": []}))


DAMAGES: dict[str, tuple[Damage, str]] = {
    "emptied": (keep_lines(0), "lines 1 to 4 are missing"),
    "last line deleted": (keep_lines(-1), "line 4 is missing"),
    "last line edited": (edit_line(-1), "jsonl:4 was changed: its digest is not the recorded one"),
    "cut inside the last line": (cut_inside_a_line, "line 4 is missing or truncated"),
    "removed": (remove(LOG_FILE), "log.jsonl with its 4 lines is missing"),
    "removed with the view": (remove(LOG_FILE, ALIASES_FILE), "log.jsonl with its 4 lines is"),
    "an earlier line edited": (edit_line(1), "jsonl:3 does not follow"),
    "head removed": (remove(HEAD_FILE), "head.json is missing"),
    "head damaged": (lambda home: void((home / HEAD_FILE).write_text("{")), "cannot be read"),
    "roles of the head edited": (edit_head, "head.json was changed: its roles differ"),
    "head of another time": (older_head, "has 4 lines but head.json records 1"),
}
damages = pytest.mark.parametrize(("damage", "words"), DAMAGES.values(), ids=DAMAGES)


def content_of(home: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in home.iterdir() if path.is_file()}


def called(home: Path, *words: object) -> str:
    """Run `hil models` and return what it prints, or raise its error."""
    command = ["models", *map(str, words), "--registry", str(home.parent)]
    done = CliRunner().invoke(app, command)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.output


@damages
def test_check_names_the_damage_and_writes_nothing(damage: Damage, words: str, home: Path) -> None:
    damage(home)
    before = content_of(home)
    with pytest.raises(RegistryError, match=words) as error:
        called(home, "check")
    assert exit_code_of(error.value) == 11
    assert f"hil models repair ur5 --registry {home.parent}" in error.value.hint
    assert content_of(home) == before


@damages
def test_no_writer_goes_on_after_a_damage(
    damage: Damage, words: str, home: Path, folders: list[Path]
) -> None:
    damage(home)
    before, registry = content_of(home), Registry(home.parent)
    for write in (
        lambda: registry.promote("ur5", 1, reason="", evidence={}, instead_of=0),
        lambda: registry.promote("ur5", 1, reason="", evidence={}, instead_of=2),
        lambda: registry.keep("ur5", 1, reason="", evidence={}),
        lambda: registry.roll_back("ur5", reason=""),
        lambda: registry.register("ur5", folders[2], {}),
        lambda: registry.rebuild("ur5"),
    ):
        with pytest.raises(RegistryError, match=words):
            write()
    assert content_of(home) == before
    assert [one.label for one in registry.versions("ur5")] == ["v1", "v2"]


@pytest.mark.thorough
@damages
def test_repair_brings_the_champion_back_and_keeps_the_old_files(
    damage: Damage, words: str, home: Path
) -> None:
    damage(home)
    before, registry = content_of(home), Registry(home.parent)
    done = registry.repair("ur5")
    assert done is not None
    assert registry.aliases("ur5").to_dict() == {"champion": 2, "challenger": None, "before": [1]}
    assert content_of(done.aside) == {
        name: before[name] for name in (LOG_FILE, HEAD_FILE, ALIASES_FILE) if name in before
    }
    registered = [one.version for one in registry.log("ur5") if one.event == "registered"]
    assert registered == [1, 2]
    last = registry.log("ur5")[-1]
    assert (last.event, last.version) == ("repaired", 2)
    assert words.split("jsonl")[-1] in last.reason
    assert "all unchanged since registration" in called(home, "check")
    assert registry.roll_back("ur5", reason="").champion == 1


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (keep_lines(0), "lines that registered v1, v2 are missing"),
        (keep_lines(-1), "no line leads to champion v2, as in aliases.json"),
        (cut_inside_a_line, "no line leads to champion v2"),
        (remove(LOG_FILE), "lines that registered v1, v2 are missing"),
    ],
)
def test_an_older_registry_is_compared_with_its_view(
    damage: Damage, words: str, old_home: Path
) -> None:
    damage(old_home)
    before, registry = content_of(old_home), Registry(old_home.parent)
    with pytest.raises(RegistryError, match=words):
        called(old_home, "check")
    assert content_of(old_home) == before
    registry.repair("ur5")
    assert registry.aliases("ur5").champion == 2


def test_an_older_registry_adopts_a_head_once(old_home: Path) -> None:
    registry, lines = Registry(old_home.parent), lines_of(old_home)
    assert registry.aliases("ur5").champion == 2  # reading writes nothing
    assert not (old_home / HEAD_FILE).exists()
    called(old_home, "check")
    called(old_home, "check")
    assert lines_of(old_home)[:-1] == lines
    assert [one.event for one in registry.log("ur5")][-2:] == ["promoted", "head-adopted"]
    keep_lines(-1)(old_home)
    with pytest.raises(RegistryError, match="line 5 is missing"):
        registry.aliases("ur5")


def test_a_head_one_behind_is_sound_and_the_next_writer_heals_it(
    home: Path, folders: list[Path]
) -> None:
    """As after a kill between the line and the head."""
    registry, head = Registry(home.parent), (home / HEAD_FILE).read_bytes()
    registry.roll_back("ur5", reason="")
    now = (home / HEAD_FILE).read_bytes()
    (home / HEAD_FILE).write_bytes(head)
    assert registry.aliases("ur5").champion == 1
    called(home, "check")
    assert (home / HEAD_FILE).read_bytes() == now


@pytest.mark.parametrize("fixture", ["home", "old_home"])
def test_a_head_that_was_never_written_is_one_behind(
    fixture: str, request: pytest.FixtureRequest, folders: list[Path]
) -> None:
    """As after a kill between the first line with a number, or the adoption's, and the head."""
    home: Path = request.getfixturevalue(fixture)
    if fixture == "home":
        shutil.rmtree(home)
        Registry(home.parent).register("ur5", folders[0], {})
    else:
        called(home, "check")
    (home / HEAD_FILE).unlink()
    before = lines_of(home)
    called(home, "check")
    assert lines_of(home) == before
    assert (home / HEAD_FILE).exists()


def test_a_torn_append_is_sound(home: Path) -> None:
    """As after a kill inside a write: the head is of the whole lines before it."""
    with (home / LOG_FILE).open("ab") as file:
        file.write(b'{"event": "promoted", "ver')
    registry = Registry(home.parent)
    assert registry.repair("ur5") is None
    assert registry.roll_back("ur5", reason="").champion == 1
    assert [one.event for one in registry.log("ur5")][-1] == "rolled-back"


def test_what_needs_no_log_is_readable_after_a_damage(home: Path) -> None:
    keep_lines(0)(home)
    assert "log damaged" in called(home, "list")
    listed = json.loads(CliRunner().invoke(
        app, ["models", "list", "--json", "--registry", str(home.parent)]
    ).stdout)["models"]  # fmt: skip
    assert listed[0]["champion"] is None
    assert "are missing" in listed[0]["problem"]
    assert "v2" in called(home, "show", "ur5")
    assert '"number": 2' in called(home, "show", "ur5", "v2")
    assert Registry(home.parent).load("ur5", "v2").predict(moving(9)).effort.size
    with pytest.raises(RegistryError, match="are missing"):
        called(home, "show", "ur5", "champion")


def test_a_check_names_every_damaged_name(home: Path, folders: list[Path]) -> None:
    Registry(home.parent).register("lab", folders[0], {})
    Registry(home.parent).register("zoo", folders[0], {})
    for name in ("ur5", "zoo"):
        keep_lines(0)(home.parent / name)
    with pytest.raises(RegistryError, match=r"ur5/log.*zoo/log"):
        called(home, "check")


def test_a_repair_says_what_it_does(home: Path) -> None:
    keep_lines(2)(home)
    said = " ".join(called(home, "repair", "ur5").split())
    assert "lines 3 to 4 are missing" in said
    assert "intact lines: 2; versions added from folders: v2" in said
    assert "champion v2 (from head.json)" in said
    assert "damaged-" in said
    assert "the log is intact, nothing to repair" in called(home, "repair", "ur5")


def test_a_repair_that_is_killed_can_be_repeated(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep_lines(1)(home)
    registry = Registry(home.parent)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("hil.models.log._write_head", killed)
        with pytest.raises(KeyboardInterrupt):
            registry.repair("ur5")
    assert registry.problem("ur5") is not None
    registry.repair("ur5")
    assert registry.aliases("ur5").champion == 2


def test_a_repair_without_any_witness_says_that_there_is_no_champion(home: Path) -> None:
    remove(LOG_FILE, HEAD_FILE, ALIASES_FILE)(home)
    assert "no file names a champion" in " ".join(called(home, "repair", "ur5").split())
    assert Registry(home.parent).aliases("ur5").champion == 0


def lose(*numbers: int) -> Damage:
    """Delete the folders of versions."""

    def delete(home: Path) -> None:
        for number in numbers:
            shutil.rmtree(home / f"v{number:04d}")

    return delete


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ([2], r"version folders .* are missing: v0002 \(champion\)\n"),
        ([1], r"version folders .* are missing: v0001\n"),
        ([1, 2], r"version folders .* are missing: v0001, v0002 \(champion\)\n"),
    ],
)
@pytest.mark.parametrize("fixture", ["home", "old_home"])
def test_a_lost_version_folder_is_a_problem_and_stops_every_writer(
    numbers: list[int],
    words: str,
    fixture: str,
    request: pytest.FixtureRequest,
    folders: list[Path],
) -> None:
    home: Path = request.getfixturevalue(fixture)
    lose(*numbers)(home)
    before, registry = content_of(home), Registry(home.parent)
    with pytest.raises(RegistryError) as error:
        called(home, "check")
    assert exit_code_of(error.value) == 11
    for write in (
        lambda: registry.register("ur5", folders[2], {}),
        lambda: registry.promote("ur5", 3 - numbers[0], reason="", evidence={}, instead_of=2),
        lambda: registry.roll_back("ur5", reason=""),
        lambda: registry.aliases("ur5"),
    ):
        with pytest.raises(RegistryError):
            write()
    with pytest.raises(RegistryError, match=words):
        registry.aliases("ur5")
    assert content_of(home) == before
    assert "log damaged" in called(home, "list")


def test_a_repair_takes_the_roles_from_lost_versions_and_records_them(
    home: Path, folders: list[Path]
) -> None:
    lose(2)(home)
    said = " ".join(called(home, "repair", "ur5").split())
    assert "lost versions, which have no role any more: v2" in said
    assert "there is no champion: the next promotion is the first" in said
    assert f"make v1 champion again: hil models rollback ur5 --registry {home.parent}" in said
    registry = Registry(home.parent)
    assert registry.log("ur5")[-1].evidence["lost"] == [2]
    assert registry.aliases("ur5").to_dict() == {
        "champion": None, "challenger": None, "before": [1]
    }  # fmt: skip
    assert "all unchanged since registration" in called(home, "check")
    assert registry.roll_back("ur5", reason="").champion == 1


@pytest.mark.parametrize("numbers", [[2], [1, 2]])
def test_the_number_of_a_lost_version_is_not_used_again(
    numbers: list[int], home: Path, folders: list[Path]
) -> None:
    lose(*numbers)(home)
    registry = Registry(home.parent)
    registry.repair("ur5")
    assert registry.repair("ur5") is None
    assert registry.register("ur5", folders[2], {}).number == 3
    assert registry.aliases("ur5").champion == 0


def test_a_lost_champion_is_recorded_also_if_its_line_is_lost(
    home: Path, folders: list[Path]
) -> None:
    lose(2)(home)
    keep_lines(2)(home)
    registry = Registry(home.parent)
    done = registry.repair("ur5")
    assert done is not None
    assert done.lost == (2,)
    assert registry.register("ur5", folders[2], {}).number == 3


def test_a_lost_version_that_is_restored_after_a_repair_is_entered_again(
    home: Path, tmp_path: Path
) -> None:
    shutil.move(home / "v0002", tmp_path / "v0002")
    registry = Registry(home.parent)
    registry.repair("ur5")
    shutil.move(tmp_path / "v0002", home / "v0002")
    called(home, "check")
    assert [one.label for one in registry.versions("ur5")] == ["v1", "v2"]
    assert registry.log("ur5")[-1].to_dict()["event"] == "registered"
    assert registry.aliases("ur5").champion == 0


def test_a_kill_between_folder_and_line_is_no_damage(
    home: Path, folders: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder appears first, so that each line that registers has its folder."""
    registry = Registry(home.parent)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("hil.models.model_registry.append", killed)
        with pytest.raises(KeyboardInterrupt):
            registry.register("ur5", folders[2], {})
    assert registry.problem("ur5") is None
    called(home, "check")
    assert [one.version for one in registry.log("ur5") if one.event == "registered"] == [1, 2, 3]


def test_a_repair_counts_the_lines_it_sets_aside(home: Path) -> None:
    lines = lines_of(home)
    (home / LOG_FILE).write_bytes(b"".join([lines[0], b"garbage\n", *lines[2:], b"torn"]))
    said = " ".join(called(home, "repair", "ur5").split())
    aside = next(home.glob("damaged-*"))
    assert f"damaged lines: 4, not in the new log, only in {aside / LOG_FILE}" in said
    assert "champion v2 (from head.json)" in said


# kill -9 at random moments, several writers at once: what was said to be done is done


KILLS = 3
WRITER = FILES / "registry_writer.py"


@pytest.fixture(scope="module")
def four_models(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    home = tmp_path_factory.mktemp("models")
    fits = [estimator("rigid-wls").fit(moving(1, 2, seed), nominal()) for seed in (3, 4, 5, 6)]
    return [fit.save(home / str(k)) for k, fit in enumerate(fits)]


@pytest.mark.thorough
def test_nothing_that_was_done_is_undone_by_a_kill(four_models: list[Path], tmp_path: Path) -> None:
    dice, root = random.Random(7), tmp_path / "registry"
    for kill in range(KILLS):
        writers = [_writer(root, 100 * kill + k, four_models) for k in range(2)]
        time.sleep(dice.uniform(0.0, 0.25))
        said = [_killed(writer) for writer in writers]
        _consistent(root, said)


def _writer(root: Path, seed: int, four_models: list[Path]) -> subprocess.Popen[str]:
    command = [sys.executable, str(WRITER), str(root), str(seed), *map(str, four_models)]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    assert writer.stdout.readline() == "ready\n"
    return writer


def _killed(writer: subprocess.Popen[str]) -> list[str]:
    assert writer.poll() is None, "it ended by itself"
    writer.kill()
    said, _ = writer.communicate(timeout=20)
    return [line for line in said.split("\n")[:-1] if line]


def _consistent(root: Path, said: list[list[str]]) -> None:
    home, registry = root / "arm", Registry(root)
    if not numbers_in(home):
        assert not any(said)
        return
    log = read_log(home)  # every line whole, and behind the one before it
    done = [f"{entry.event} {entry.version}" for entry in log]
    for lines in said:
        # In the order in which it was said, all of it is there.
        deeds = iter(done)
        missing = [line for line in lines if line.split()[0] != "registered" and line not in deeds]
        assert not missing
    registry.rebuild("arm")
    versions = registry.versions("arm")
    assert [version.number for version in versions] == list(range(1, len(versions) + 1))
    assert len({version.digest for version in versions}) == len(versions)
    for version in versions:
        version.verify()
    entered = [one.version for one in read_log(home) if one.event == "registered"]
    assert sorted(entered) == [version.number for version in versions]
    now = Aliases.after(read_log(home))
    assert now == registry.aliases("arm")
    assert now.champion in (0, *entered)
    assert registry.register("arm", versions[0].folder, {}).number == 1
