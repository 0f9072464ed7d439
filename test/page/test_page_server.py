# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The page's web server, without ROS and browser: who may come, who is told what, and clients that misbehave."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import http.client
import json
import os
import re
import socket
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

from calib_planner.errors import InputError
from calib_planner.ros import page_server
from calib_planner.ros.page_server import Access, Answer, PageServer, Sections, is_local, policy

aiohttp = pytest.importorskip("aiohttp", reason="the page needs aiohttp (extra page)")

PAGE = "<!DOCTYPE html><style>b { color: red }</style><script>let a = 1;</script>"
TOKEN = "a-token-of-some-length"
Made = Callable[..., PageServer[int]]


Changes = list[tuple[str, Callable[[], Any]]]


def changed(before: int | None, after: int) -> Changes:
    """Section ``n`` changes with every state, ``ten`` with every tenth."""
    return [("n", lambda: after), ("ten", lambda: after // 10)]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Made]:
    made: list[PageServer[int]] = []

    def serve(host: str = "127.0.0.1", token: str = "", **others: Any) -> PageServer[int]:
        pressed: list[tuple[str, Mapping[str, Any]]] = []

        def press(name: str, values: Mapping[str, Any]) -> Future[Answer]:
            if name == "wrong":
                raise InputError("button", name, "start")
            pressed.append((name, values))
            answer: Future[Answer] = Future()
            answer.set_result(Answer(name == "start", f"{name} {dict(values)}"))
            return answer

        said: list[str] = []
        usual: dict[str, Any] = {"changed": changed, "press": press, "reports": tmp_path, "say": said.append}
        server = PageServer(PAGE, Access.of(host, token), **(usual | others))
        server.start(host, 0)
        server.pressed, server.said = pressed, said  # type: ignore[attr-defined]
        made.append(server)
        return server

    yield serve
    for server in made:
        assert server.close()


def ask(
    server: PageServer[int], method: str, path: str, body: str | None = None, **headers: str
) -> tuple[int, dict[str, str], str]:
    """Status, headers and text; ``Host`` and ``Origin`` of a POST are the page's unless given (empty: none)."""
    own = f"127.0.0.1:{server.port}"
    usual = {"Host": own} | (
        {"Origin": f"http://{own}", "Content-Type": "application/json"} if method == "POST" else {}
    )
    usual |= {name.replace("_", "-"): value for name, value in headers.items()}
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    connection.putrequest(method, path, skip_host=True)
    for name, value in usual.items():
        if value:
            connection.putheader(name, value)
    if body is not None:
        connection.putheader("Content-Length", str(len(body)))
    connection.endheaders(None if body is None else body.encode())
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, {k.lower(): v for k, v in answer.getheaders()}, text


# ── who may come ─────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("host", "header", "fine"),
    [("127.0.0.1", "127.0.0.1:8470", True), ("127.0.0.1", "localhost", True), ("127.0.0.1", "[::1]:9", True),
     ("127.0.0.1", "LOCALHOST:1", True), ("127.0.0.1", "evil.example:8470", False), ("127.0.0.1", "", False),
     ("127.0.0.1", "192.168.0.7:8470", False), ("127.0.0.1", "localhost.evil.example", False),
     ("127.0.0.1", "[:", False), ("127.0.0.1", "evil@127.0.0.1:80", True), ("0.0.0.0", "192.168.0.7:8470", True),
     ("0.0.0.0", "[fe80::1]:80", True), ("0.0.0.0", "evil.example", False), ("cell.local", "cell.local:1", True),
     ("0.0.0.0", f"{socket.gethostname()}:8470", True)],
)  # fmt: skip
def test_by_which_names_it_may_be_called(host: str, header: str, fine: bool) -> None:
    assert (Access.of(host, TOKEN).wrong_host(header) == "") is fine


def test_which_servers_are_for_this_machine_alone() -> None:
    assert all(map(is_local, ("127.0.0.1", "localhost", "::1", "127.0.0.7")))
    assert not any(map(is_local, ("0.0.0.0", "::", "192.168.0.1", "cell.local", "")))


@pytest.mark.parametrize(
    "origin",
    [None, "", "null", "http://evil.example", "https://127.0.0.1:8470", "http://127.0.0.1:8471", "http://127.0.0.1",
     "http://127.0.0.1:8470.evil.example"],
)  # fmt: skip
def test_other_origins_are_refused(origin: str | None) -> None:
    access = Access.of("127.0.0.1", "")
    assert access.wrong_origin(origin, "127.0.0.1:8470") and not access.wrong_origin("http://a:1", "a:1")


def test_tokens() -> None:
    assert Access.of("127.0.0.1", "").token == "" and len(Access.of("0.0.0.0", "").token) >= 32
    assert Access.of("0.0.0.0", "").token != Access.of("0.0.0.0", "").token
    assert Access.of("127.0.0.1", TOKEN).wrong_token(None) and not Access.of("::1", TOKEN).wrong_token(TOKEN)
    assert Access.of("0.0.0.0", TOKEN).wrong_token(TOKEN + "x") and Access.of("0.0.0.0", TOKEN).wrong_token("ä")
    for bad in ("short", "with a blank in it", "slash/slash/slash"):
        with pytest.raises(InputError, match="token"):
            Access.of("0.0.0.0", bad)


def test_every_way_in_asks_for_host_origin_and_token(make: Made) -> None:
    server = make(token=TOKEN)
    cookie = {"Cookie": f"calib_page_{server.port}={TOKEN}"}
    own = {"Host": f"127.0.0.1:{server.port}", "Origin": f"http://127.0.0.1:{server.port}"}
    ways = [
        ("GET", "/", None),
        ("GET", "/live", None),
        ("POST", "/do/start", "{}"),
        ("GET", "/report/report_a.html", None),
    ]
    for method, path, body in ways:
        assert ask(server, method, path, body, **own)[0] == 403, path
        assert ask(server, method, path, body, **own, Cookie="calib_page_1=x")[0] == 403, path
        status, _, text = ask(server, method, path, body, **(cookie | own | {"Host": "evil.example"}))
        assert status == 403 and "not called evil.example" in text.replace("'", "")
    for path, method, body in (("/live", "GET", None), ("/do/start", "POST", "{}")):
        for origin in ("", "null", "http://evil.example"):
            assert ask(server, method, path, body, **(own | cookie | {"Origin": origin}))[0] == 403
    assert not server.pressed  # type: ignore[attr-defined]
    assert ask(server, "POST", "/do/start", "{}", **own, **cookie)[0] == 200
    assert ask(server, "GET", "/report/report_a.html", Sec_Fetch_Site="cross-site", **cookie)[0] == 403


def test_the_token_in_the_address_becomes_a_cookie_that_no_script_reads(make: Made) -> None:
    server = make(token=TOKEN)
    status, headers, _ = ask(server, "GET", f"/?token={TOKEN}")
    assert status == 303 and headers["location"] == "/"
    cookie = headers["set-cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie and TOKEN in cookie
    assert ask(server, "GET", "/", Cookie=cookie.partition(";")[0])[0] == 200
    assert ask(server, "GET", "/?token=another-token-of-length")[0] == 403


def test_what_a_browser_is_told(make: Made) -> None:
    server = make()
    status, headers, text = ask(server, "GET", "/")
    assert (status, text) == (200, PAGE)
    rules = dict(rule.strip().partition(" ")[::2] for rule in headers["content-security-policy"].split(";"))
    digest = base64.b64encode(hashlib.sha256(b"let a = 1;").digest()).decode()
    assert rules["default-src"] == "'none'" and rules["script-src"] == f"'sha256-{digest}'"
    assert rules["frame-ancestors"] == "'none'" and rules["connect-src"] == f"'self' ws://127.0.0.1:{server.port}"
    assert "unsafe" not in headers["content-security-policy"]
    assert headers["x-frame-options"] == "DENY" and headers["x-content-type-options"] == "nosniff"
    assert headers["cache-control"] == "no-store" and "access-control-allow-origin" not in headers
    assert policy("<script>a</script><script>b</script>").count("sha256") == 2


@pytest.mark.parametrize(
    ("path", "status"),
    [("/do/start", 405), ("/nothing", 404), ("/../etc/passwd", 404), ("/report/", 404), ("/report/folder", 404),
     ("/report/other.html", 404), ("/report/report_a.html", 404), ("/report/%2e%2e%2freport_a.html", 404),
     ("/report/report_..html", 404), ("/report/report_a.html%00", 404), ("/favicon.ico", 404)],
)  # fmt: skip
def test_nothing_else_is_served(make: Made, tmp_path: Path, path: str, status: int) -> None:
    (tmp_path / "report_folder.html").mkdir()
    (tmp_path / "other.html").write_text("secret")
    assert ask(make(), "GET", path)[0] == status


def test_a_report_cannot_press_buttons(make: Made, tmp_path: Path) -> None:
    (tmp_path / "report_a-fit.html").write_text("report")
    status, headers, text = ask(make(), "GET", "/report/report_a-fit.html")
    assert (status, text) == (200, "report")
    rules = headers["content-security-policy"]
    assert (
        rules.startswith("sandbox allow-scripts")
        and "allow-same-origin" not in rules
        and "connect-src" not in rules
    )


# ── buttons ──────────────────────────────────────────────────────────────────────────────────────────


def test_a_button_gets_the_answer(make: Made) -> None:
    server = make()
    assert json.loads(ask(server, "POST", "/do/start", '{"number": 3}')[2]) == {
        "done": True,
        "text": "start {'number': 3}",
    }
    assert json.loads(ask(server, "POST", "/do/pause", "{}")[2])["done"] is False
    status, _, text = ask(server, "POST", "/do/wrong", "{}")
    assert status == 400 and "expected start" in text.replace("valid is", "expected")
    assert [n for n, _ in server.pressed] == ["start", "pause"]  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("body", "kind", "status"),
    [("{}", "text/plain", 415), ("[]", "application/json", 400), ("{", "application/json", 400),
     ("", "application/json", 400),
     ('{"a": "' + 5000 * "x" + '"}', "application/json", 413), ("{}", "application/x-www-form-urlencoded", 415),
     (400 * "[" , "application/json", 400), ('{"a": NaN}', "application/json", 200)],
)  # fmt: skip
def test_what_is_no_button(make: Made, body: str, kind: str, status: int) -> None:
    assert ask(make(), "POST", "/do/start", body, Content_Type=kind)[0] == status


# ── what is shown ────────────────────────────────────────────────────────────────────────────────────


def test_only_what_is_new_is_sent() -> None:
    sections = Sections()
    sections.take("a", 1)
    sections.take("b", {"x": None})
    assert sections.newest == 2 and json.loads(sections.since(-1)) == {"a": 1, "b": {"x": None}}
    sections.take("a", 1)
    assert sections.newest == 2 and json.loads(sections.since(2)) == {}
    sections.take("a", 2)
    assert json.loads(sections.since(2)) == {"a": 2}


async def opened(session: Any, server: PageServer[int], **headers: str) -> Any:
    own = f"127.0.0.1:{server.port}"
    usual = {"Origin": f"http://{own}"} | headers
    return await session.ws_connect(f"http://{own}/live", headers=usual, max_msg_size=0)


async def told(client: Any, n: int) -> list[dict[str, Any]]:
    """What a client is told until section ``n`` has this value."""
    heard: list[dict[str, Any]] = []
    while not heard or heard[-1].get("n") != n:
        message = await asyncio.wait_for(client.receive(), 30)
        assert message.type == aiohttp.WSMsgType.TEXT, message
        heard.append(json.loads(message.data))
    return heard


def test_a_client_gets_everything_and_then_what_changes(make: Made) -> None:
    server = make()

    async def watch() -> None:
        async with aiohttp.ClientSession() as session:
            server.show(11)
            client = await opened(session, server)
            assert (await told(client, 11))[-1] == {"n": 11, "ten": 1}
            server.show(12)
            assert await told(client, 12) == [{"n": 12}]
            server.show(20)
            assert await told(client, 20) == [{"n": 20, "ten": 2}]

    asyncio.run(watch())


def test_a_quiet_server_says_that_it_is_there(make: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_server, "PULSE", 0.05)
    server = make()

    async def watch() -> None:
        async with aiohttp.ClientSession() as session:
            client = await opened(session, server)
            assert [(await client.receive()).data for _ in range(3)] == ["{}"] * 3

    asyncio.run(watch())


def test_twenty_clients_of_which_half_never_read(make: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that read are told the newest; nothing is kept for the others, and they are left in the end."""
    monkeypatch.setattr(page_server, "SILENCE", 3.0)  # long enough for readers on a busy machine
    bulk = "x" * 300_000
    server = make(changed=lambda _, after: [("n", lambda: after), ("bulk", lambda: f"{after}{bulk}")])

    async def watch() -> None:
        async with aiohttp.ClientSession() as session:
            clients = [await opened(session, server) for _ in range(20)]
            newest = [0] * 10

            async def read(k: int) -> None:
                async for message in clients[k]:
                    newest[k] = json.loads(message.data).get("n", newest[k])

            readers = [asyncio.ensure_future(read(k)) for k in range(10)]
            for client in clients[10:]:
                client._response.connection.transport.pause_reading()
            for n in range(1, 101):
                server.show(n)
                await asyncio.sleep(0)
            while newest != [100] * 10:
                await asyncio.sleep(0.01)
            one = clients[10]
            one._response.connection.transport.resume_reading()
            assert len(await told(one, 100)) < 50
            one._response.connection.transport.pause_reading()
            while server.clients > 10:
                n += 1
                server.show(n)
                await asyncio.sleep(0.1)
            assert server.clients == 10
            while newest != [n] * 10:
                await asyncio.sleep(0.01)
            for reader in readers:
                reader.cancel()

    asyncio.run(asyncio.wait_for(watch(), 90))


def test_show_does_not_wait_for_the_server(make: Made) -> None:
    """A server that is busy takes the newest state only."""
    import threading

    go, seen = threading.Event(), list[int]()

    def slowly(before: int | None, after: int) -> Changes:
        seen.append(after)
        go.wait(30)
        return [("n", lambda: after)]

    server = make(changed=slowly)
    for n in range(1000):
        server.show(n)
    go.set()

    async def watch() -> None:
        async with aiohttp.ClientSession() as session:
            await told(await opened(session, server), 999)

    asyncio.run(watch())
    assert len(seen) <= 3 and seen[-1] == 999


def test_a_client_that_talks_is_left_and_the_others_are_not(make: Made) -> None:
    server = make()

    async def watch() -> None:
        async with aiohttp.ClientSession() as session:
            good = await opened(session, server)
            for size in (1, 1_000_000):
                bad = await opened(session, server)
                await bad.send_bytes(os.urandom(size))
                while (await asyncio.wait_for(bad.receive(), 30)).type == aiohttp.WSMsgType.TEXT:
                    pass
            server.show(5)
            await told(good, 5)

    asyncio.run(watch())


def test_too_many_pages_are_refused(make: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_server, "MOST_CLIENTS", 3)
    server = make()

    async def watch() -> None:
        async with aiohttp.ClientSession() as session:
            clients = [await opened(session, server) for _ in range(3)]
            with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
                await opened(session, server)
            await clients[0].close()
            while server.clients == 3:
                await asyncio.sleep(0.01)
            await opened(session, server)

    asyncio.run(asyncio.wait_for(watch(), 30))


def test_half_a_request_and_noise_do_no_harm(make: Made) -> None:
    server = make()
    sockets = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(30)]
    for i, each in enumerate(sockets):
        each.sendall(b"GET / HTTP/1.1\r\nHost: 127" if i % 2 else os.urandom(500))
    assert ask(server, "GET", "/")[0] == 200
    for each in sockets:
        each.close()
    assert ask(server, "GET", "/", Host="", X="1")[0] in (400, 403)


def test_a_fault_in_what_is_shown_does_not_end_the_page(make: Made) -> None:
    def broken(before: int | None, after: int) -> Changes:
        return [("bad", lambda: 1 / 0), ("n", lambda: after)]

    server = make(changed=broken)

    async def watch() -> None:
        async with aiohttp.ClientSession() as session:
            client = await opened(session, server)
            server.show(1)
            assert (await told(client, 1))[-1] == {"n": 1}
            server.show(2)
            await told(client, 2)

    asyncio.run(asyncio.wait_for(watch(), 30))
    assert re.match("bad is not shown: ZeroDivisionError", server.said[0])  # type: ignore[attr-defined]


def test_the_end_is_told_to_the_clients(make: Made) -> None:
    server = make()

    async def watch() -> None:
        async with aiohttp.ClientSession() as session:
            client = await opened(session, server)
            loop = asyncio.get_running_loop()
            ended = loop.run_in_executor(None, server.close)
            while (await asyncio.wait_for(client.receive(), 30)).type == aiohttp.WSMsgType.TEXT:
                pass
            assert await ended and client.closed

    asyncio.run(watch())
    server.show(1)  # of no use, and no harm


def test_an_address_in_use_is_refused(make: Made) -> None:
    server = make()
    again = PageServer(PAGE, Access.of("127.0.0.1", ""), changed, lambda name, values: Future())
    with pytest.raises(InputError, match="choose another port, or 0 for any"):
        again.start("127.0.0.1", server.port)
