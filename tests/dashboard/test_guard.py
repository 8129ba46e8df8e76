"""Who may look at the dashboard, and who may act: also on loopback, where any web page can post."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from starlette.routing import Route
from starlette.testclient import TestClient

from hil.cli.serve import serve, specs_folder
from hil.core.errors import SpecError
from hil.dashboard.limits import StreamLimit
from hil.dashboard.security import MOST_BYTES, POLICY
from hil.dashboard.server import browser_address, create_app
from hil.dashboard.settings import Settings

HERE = "http://127.0.0.1:8350"
TOKEN = "correct horse battery staple"


def settings(tmp_path: Path, **more: object) -> Settings:
    return Settings(runs=tmp_path / "runs", registry=tmp_path / "registry", port=8350, **more)


def client(made: Settings, base: str = HERE) -> TestClient:
    return TestClient(create_app(made), base_url=base, follow_redirects=False)


@pytest.fixture
def own(tmp_path: Path) -> Settings:
    return settings(tmp_path)


@pytest.mark.parametrize(
    ("host", "known"),
    [
        ("127.0.0.1:8350", True),
        ("localhost:8350", True),
        ("[::1]:8350", True),
        ("127.0.0.1.evil.example", False),
        ("evil.example:8350", False),
        ("192.168.0.7:8350", False),
        ("", False),
    ],
)
def test_on_loopback_only_names_of_loopback_are_ours(own: Settings, host: str, known: bool) -> None:
    answer = client(own).get("/", headers={"host": host})
    assert (answer.status_code == 200) is known


def test_elsewhere_addresses_and_given_names_are_ours(tmp_path: Path) -> None:
    made = settings(tmp_path, host="0.0.0.0", names=("lab-pc",), token=TOKEN)
    assert made.knows("192.168.0.7:8350")
    assert made.knows("LAB-PC:8350")
    assert not made.knows("evil.example")


def test_a_form_of_ours_is_taken(own: Settings) -> None:
    answer = client(own).post("/who", data={"csrf": own.csrf, "who": "Žofie & co"})
    assert answer.status_code == 303
    assert "HttpOnly" in answer.headers["set-cookie"]
    assert "SameSite=strict" in answer.headers["set-cookie"]
    named = client(own)
    named.cookies.set("hil_who", answer.headers["set-cookie"].split(";")[0].partition("=")[2])
    assert 'value="Žofie &amp; co"' in named.get("/").text


@pytest.mark.parametrize("shown", ["", "x", "ž", None])
def test_a_form_without_the_value_only_our_pages_show_is_refused(
    own: Settings, shown: str | None
) -> None:
    data = {"who": "me"} | ({} if shown is None else {"csrf": shown})
    answer = client(own).post("/who", data=data)
    assert answer.status_code == 403
    assert "reload" in answer.text
    assert "set-cookie" not in answer.headers


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "https://evil.example"},
        {"origin": "null"},
        {"origin": "http://127.0.0.1:9999"},
        {"sec-fetch-site": "cross-site"},
        {"sec-fetch-site": "same-site"},
    ],
)
def test_what_another_site_asks_is_refused_though_it_knew_the_value(
    own: Settings, headers: dict[str, str]
) -> None:
    answer = client(own).post("/who", data={"csrf": own.csrf, "who": "me"}, headers=headers)
    assert answer.status_code == 403
    assert "another site" in answer.text


def test_our_own_origin_may_ask(own: Settings) -> None:
    headers = {"origin": HERE, "sec-fetch-site": "same-origin"}
    answer = client(own).post("/who", data={"csrf": own.csrf, "who": "me"}, headers=headers)
    assert answer.status_code == 303


def test_a_huge_form_is_refused(own: Settings) -> None:
    answer = client(own).post("/who", content=b"a" * (MOST_BYTES + 1))
    assert answer.status_code == 403
    assert str(MOST_BYTES) in answer.text


def test_read_only_nothing_can_be_asked(tmp_path: Path) -> None:
    made = settings(tmp_path, read_only=True)
    answer = client(made).post("/who", data={"csrf": made.csrf, "who": "me"})
    assert answer.status_code == 403
    shown = client(made).get("/").text
    assert "read-only" in shown
    assert "<form" not in shown


def test_without_the_token_nothing_is_shown(tmp_path: Path) -> None:
    made = settings(tmp_path, token=TOKEN)
    for path in ("/", "/runs", "/static/hil.css", "/?token=wrong", "/nothing"):
        answer = client(made).get(path)
        assert answer.status_code == 401
        assert "hil serve" in answer.text
    refused = client(made).post("/who", data={"csrf": made.csrf, "who": "me"})
    assert refused.status_code == 401


def test_the_token_opens_once_and_leaves_the_address(tmp_path: Path) -> None:
    made = settings(tmp_path, token=TOKEN)
    visitor = client(made)
    first = visitor.get("/", params={"token": TOKEN, "query": "a b"})
    assert first.status_code == 303
    assert first.headers["location"] == "/?query=a+b"
    assert visitor.get("/").status_code == 200  # by its cookie
    assert client(made).get("/", headers={"authorization": f"Bearer {TOKEN}"}).status_code == 200


def test_a_token_in_an_address_does_not_let_anything_be_asked(tmp_path: Path) -> None:
    made = settings(tmp_path, token=TOKEN)
    answer = client(made).post("/who", params={"token": TOKEN}, data={"csrf": made.csrf})
    assert answer.status_code == 401


@pytest.mark.parametrize("path", ["/", "/nothing", "/static/hil.css"])
def test_every_answer_carries_the_policy(own: Settings, path: str) -> None:
    answer = client(own).get(path)
    assert answer.headers["content-security-policy"] == POLICY
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["cache-control"] == "no-store"


def test_a_form_leads_back_only_to_pages_of_ours(own: Settings) -> None:
    for referer in ("https://evil.example/x", f"{HERE}//evil.example/x", "javascript:alert(1)"):
        data = {"csrf": own.csrf, "who": "me"}
        answer = client(own).post("/who", data=data, headers={"referer": referer})
        assert not answer.headers["location"].startswith("//")
        assert "evil" not in answer.headers["location"] or answer.headers["location"][1] != "/"


def test_what_is_not_there_is_told_as_a_page_or_as_json(own: Settings) -> None:
    page = client(own).get("/<b>x", headers={"accept": "text/html"})
    assert page.status_code == 404
    assert "<b>x" not in page.text
    assert client(own).get("/nothing").json()["error"]


def test_a_page_that_fails_says_so_and_leaves_the_others(own: Settings) -> None:
    def broken(request: object) -> None:
        raise ValueError("two <b>")

    made = create_app(own)
    made.router.routes.insert(0, Route("/broken", broken))
    visitor = TestClient(made, base_url=HERE, raise_server_exceptions=False)
    answer = visitor.get("/broken", headers={"accept": "text/html"})
    assert answer.status_code == 500
    assert "ValueError: two &lt;b&gt;" in answer.text
    assert answer.headers["content-security-policy"] == POLICY
    assert visitor.get("/").status_code == 200


@pytest.mark.parametrize(
    ("headers", "taken"), [({"origin": HERE}, True), ({}, False), ({"origin": "null"}, False)]
)
def test_stop_is_taken_from_a_page_of_an_earlier_dashboard(
    own: Settings, headers: dict[str, str], taken: bool
) -> None:
    data = {"csrf": "of the one before"}
    answer = client(own).post("/runs/2026/ur5/0001-a/stop", data=data, headers=headers)
    assert answer.status_code == (404 if taken else 403)  # there is no such run
    other = client(own).post("/runs/2026/ur5/0001-a/pause", data=data, headers=headers)
    assert other.status_code == 403


def test_a_file_that_may_not_be_read_is_no_forbidden_form(own: Settings) -> None:
    def closed(request: object) -> None:
        raise PermissionError(13, "Permission denied", "/lab/runs")

    made = create_app(own)
    made.router.routes.insert(0, Route("/closed", closed))
    answer = TestClient(made, base_url=HERE).get("/closed")
    assert answer.status_code == 500
    assert "/lab/runs: Permission denied" in answer.json()["error"]


def test_a_token_of_the_environment_is_not_printed(tmp_path: Path) -> None:
    made = settings(tmp_path, token="k" * 16)
    assert browser_address(made) == f"http://127.0.0.1:{made.port}/?token={'k' * 16}"
    assert browser_address(replace(made, token_given=True)) == f"http://127.0.0.1:{made.port}/"
    assert "kkk" not in repr(made)


def test_a_network_may_not_guess_the_token(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HIL_TOKEN", "k" * 15)
    with pytest.raises(SpecError, match="15 characters"):
        serve(host="0.0.0.0", port=0)


def test_so_many_may_listen_and_no_more() -> None:
    waiting, over = 0, asyncio.Event()
    answers: list[int] = []

    async def forever(scope: object, receive: object, send: object) -> None:
        nonlocal waiting
        waiting += 1
        await over.wait()

    async def send(message: Any) -> None:
        if message["type"] == "http.response.start":
            answers.append(message["status"])

    async def listen(app: StreamLimit, path: str) -> None:
        await app({"type": "http", "method": "GET", "path": path}, None, send)  # type: ignore[arg-type]

    async def everybody() -> None:
        app = StreamLimit(forever, most=2)  # type: ignore[arg-type]
        paths = ["/events", "/runs/2026/ur5/0001-a/events", "/events", "/runs"]
        asked = [asyncio.create_task(listen(app, path)) for path in paths]
        await asyncio.sleep(0)
        assert (waiting, answers) == (3, [503])  # the page passes
        over.set()
        await asyncio.gather(*asked)
        await listen(app, "/events")  # there is room again
        assert (waiting, answers) == (4, [503])

    asyncio.run(everybody())


@pytest.mark.thorough
def test_as_many_files_may_be_open_as_are_allowed() -> None:
    told = (
        "import resource as r; from hil.dashboard import server\n"
        "r.setrlimit(r.RLIMIT_NOFILE, (64, 128)); server._allow_many_files()\n"
        "print(*r.getrlimit(r.RLIMIT_NOFILE))"
    )
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True)
    assert done.stdout.split() == ["128", "128"], done.stderr


def test_specs_offered_are_those_of_the_lab_or_of_this_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert specs_folder(None) == Path()
    Path("experiments").mkdir()
    assert specs_folder(None) == Path("experiments")
    with pytest.raises(SpecError, match="--specs elsewhere is no folder"):
        specs_folder(Path("elsewhere"))
