"""Units for systemd, and the command that is told what came of an occasion."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hil.core.errors import RecordingError, SpecError
from hil.maintenance.scheduler import Command
from hil.maintenance.systemd import next_words, units_of, write_units

ANALYZE = shutil.which("systemd-analyze")
ODD = 'a b/100 % of "$HOME"\\x/nightly.yaml'


@pytest.mark.thorough
@pytest.mark.skipif(ANALYZE is None, reason="no systemd here")
@pytest.mark.parametrize("timer", [False, True], ids=["service", "timer"])
@pytest.mark.parametrize("user", [False, True], ids=["system", "user"])
def test_systemd_finds_nothing_wrong(tmp_path: Path, timer: bool, user: bool) -> None:
    assert ANALYZE
    units = units_of("nightly", (f"/{ODD}",), tmp_path, timer=timer, user=user)
    files = write_units(units, tmp_path)
    command = [ANALYZE, *(["--user"] if user else []), "verify", *map(str, files)]
    surroundings = {"XDG_RUNTIME_DIR": str(tmp_path), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(command, capture_output=True, text=True, env=surroundings, check=False)
    told = [line for line in done.stderr.splitlines() if "hil-nightly" in line]
    assert told == []


def test_a_service_stays_and_a_timer_calls_once(tmp_path: Path) -> None:
    (service,) = units_of("nightly", ("/n.yaml",), tmp_path, timer=False, user=False)
    assert service.name == "hil-nightly.service"
    assert f"ExecStart={sys.executable} -P -m hil schedule run /n.yaml\n" in service.text
    for wanted in ("Type=exec", "Restart=on-failure", "KillSignal=SIGTERM", "User=",
                   "SuccessExitStatus=130", f"WorkingDirectory={tmp_path}"):  # fmt: skip
        assert f"\n{wanted}" in service.text
    called, timer = units_of("nightly", ("/n.yaml",), tmp_path, timer=True, user=True)
    assert "/n.yaml --once\n" in called.text
    assert "Type=oneshot" in called.text
    assert "Restart=" not in called.text
    assert "User=" not in called.text
    assert "Persistent=true" in timer.text
    assert next_words([called, timer], tmp_path, user=True)[-2].endswith("hil-nightly.timer")


def test_paths_are_themselves_whatever_is_in_them(tmp_path: Path) -> None:
    (unit,) = units_of("nightly", (f"/{ODD}",), Path("/100%"), timer=False, user=True)
    assert '"/a b/100 %% of \\"$$HOME\\"\\\\x/nightly.yaml"' in unit.text
    assert "WorkingDirectory=/100%%\n" in unit.text
    with pytest.raises(SpecError, match="cannot have"):
        units_of("nightly", ("/a\nb",), tmp_path, timer=False, user=True)


def test_the_folder_of_units_is_made(tmp_path: Path) -> None:
    units = units_of("nightly", ("/n.yaml",), tmp_path, timer=True, user=True)
    for path in write_units(units, tmp_path / "new" / "units"):
        assert path.read_text()
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot make"):
        write_units(units, tmp_path / "file")


def test_leases_are_looked_for_where_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HIL_LEASES", "/srv/hil leases")
    monkeypatch.delenv("HIL_STATION", raising=False)
    (unit,) = units_of("nightly", (), tmp_path, timer=False, user=True)
    assert '\nEnvironment="HIL_LEASES=/srv/hil leases"\n' in unit.text
    assert "HIL_STATION" not in unit.text


def test_a_command_is_told_in_json_without_a_shell(tmp_path: Path) -> None:
    out = tmp_path / "told"
    code = "import sys; open(sys.argv[1], 'w').write(sys.argv[2] + '\\n' + sys.stdin.read())"
    command = Command((sys.executable, "-c", code, str(out), "$HOME; ls"), "nightly")
    assert (
        command({"event": "done", "occasion": "x", "result": {"text": "größer"}, "before": "ab"})
        == ""
    )
    argument, told = out.read_text().splitlines()
    assert argument == "$HOME; ls"
    wanted = {"schedule": "nightly", "event": "done", "occasion": "x", "result": {"text": "größer"}}
    assert json.loads(told) == wanted


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("/no/such/command",), "/no/such/command cannot be run: [Errno 2]"),
        (("sh", "-c", "echo first >&2; echo no mail >&2; exit 3"), "sh ended with 3: no mail"),
        (("sh", "-c", "kill -9 $$"), "sh ended with -9"),
        (("nul\0",), "nul\0 cannot be run: embedded null"),
    ],
)
def test_a_command_that_fails_is_told(words: tuple[str, ...], told: str) -> None:
    assert Command(words, "nightly")({"event": "done"}).startswith(told)


def test_a_command_that_hangs_is_killed_with_its_children() -> None:
    begin = time.monotonic()
    hangs = Command(("sh", "-c", "sleep 60 & wait"), "nightly", within_s=0.2)
    assert hangs({"event": "done"}) == "sh did not end within 0.2 s"
    assert time.monotonic() - begin < 5


def test_no_command_is_no_problem() -> None:
    assert Command((), "nightly")({"event": "done"}) == ""
