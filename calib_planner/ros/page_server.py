# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The web server of the page: an event loop in a thread of its own, which the node never waits for.

*What comes in.* ``GET /`` is the page, ``GET /live`` a WebSocket that tells what changes, ``POST /do/NAME`` a
button, ``GET /report/NAME`` a written report. Nothing else is answered, and no other file is read.

*What goes out.* ``show`` takes the newest state, from any thread, and returns at once. The loop makes the
sections that changed (``changed``), once for all clients. A client has no queue: when it has taken what was sent
last, it gets the sections that are newer than its own, in their newest form. A slow client thus gets fewer and
larger messages, and one that does not read for ``SILENCE`` seconds is left.

*Who may come.* A server that steers a robot is a target for every page that the same browser shows. Therefore

* the name by which the server is called (``Host``) has to be its own, or a page could reach it by a name that it
  has bound to this address (DNS rebinding);
* a button and a WebSocket need the header ``Origin`` of the page itself, which no page can forge;
* beyond this machine a token is needed: once in the address, from then on as a cookie that no script reads.

``Access`` holds these rules as a pure value. The page's scripts and styles are named by their hashes in the
Content-Security-Policy, so that nothing else runs, whatever a topic says. A report is shown in a sandbox: its
scripts cannot press buttons.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import ipaddress
import json
import re
import secrets
import socket
import threading
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar
from urllib.parse import urlsplit

from calib_planner.errors import CalibPlannerError, InputError
from calib_planner.units import brief

LEAST_TOKEN = 16
"""Characters of a token, at least: as many as cannot be tried out."""
MOST_CLIENTS = 100
"""WebSockets at a time; a page more is answered that there are too many."""
LARGEST_REQUEST = 4096
"""Bytes of what a button sends, at most."""
PERIOD = 0.05
"""Least time between two messages to one client [s]: a tenth of a second is not seen as a delay."""
PULSE = 4.0
"""Longest time between two messages to one client [s], from which it knows that the node is there."""
SILENCE = 20.0
"""Time that a client has to take a message before it is left [s]."""
FAREWELL = 1.0
"""Time that a client has to agree to the end of its connection [s]."""
PATIENCE = 5.0
"""Time that the server has to end [s]."""
LOOPBACK = ("localhost", "127.0.0.1", "::1")
REPORT = re.compile(r"report_[A-Za-z0-9_-]{1,200}\.html")
"""Names of reports, as the identifier writes them."""
SAFE = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
SANDBOX = (
    "sandbox allow-scripts allow-modals; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data: blob:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)

T = TypeVar("T")


@dataclass(frozen=True)
class Answer:
    """What became of a button: whether it was done, and in words."""

    done: bool
    text: str


Press = Callable[[str, Mapping[str, Any]], "Future[Answer]"]
"""Name of a button and what it was sent with → its answer, some time."""


# ── who may come ─────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Access:
    """Whom the server answers.

    Attributes:
        names: The names by which it may be called, in small letters, without port; any address of digits is one
            more unless the server is for this machine alone.
        local: Whether it is for this machine alone.
        token: What a client has to know; empty if nothing.
    """

    names: frozenset[str]
    local: bool
    token: str

    @staticmethod
    def of(host: str, token: str) -> Access:
        """For a server that listens at ``host``; a token is made where one is needed and none is given.

        Raises:
            InputError: The token is too short, or has characters that do not fit into an address.
        """
        if token and not re.fullmatch(rf"[A-Za-z0-9_.~-]{{{LEAST_TOKEN},}}", token):
            raise InputError(
                "token",
                f"{len(token)} characters",
                f"at least {LEAST_TOKEN} letters, digits, dots, hyphens, tildes or underscores",
                "leave it empty, and one is made",
            )
        local = is_local(host)
        own = (
            set()
            if local
            else {host.lower(), socket.gethostname().lower(), f"{socket.gethostname().lower()}.local"}
        )
        made = token or ("" if local else secrets.token_urlsafe(24))
        return Access(frozenset({*LOOPBACK, *own}), local, made)

    def wrong_host(self, header: str) -> str:
        """Why a request for this ``Host`` is refused; empty if it is not."""
        name = _host_of(f"//{header}")
        if name in self.names or (not self.local and _is_address(name)):
            return ""
        return f"this server is not called {brief(name)}: open the address that the node has logged"

    def wrong_origin(self, origin: str | None, header: str) -> str:
        """Why something that another page may have sent is refused: its ``Origin`` has to be that of ``Host``."""
        if origin == f"http://{header}":
            return ""
        return f"this comes from another page ({brief(origin or 'unknown')}), which may not steer"

    def wrong_token(self, given: str | None) -> str:
        """Why a client is refused that gave this token."""
        if not self.token or hmac.compare_digest(self.token.encode(), (given or "").encode()):
            return ""
        return "the token is missing or wrong: open the address that the node has logged"


def is_local(host: str) -> bool:
    """Whether only this machine reaches a server that listens at ``host``."""
    return host.lower() in LOOPBACK or (_is_address(host) and ipaddress.ip_address(host).is_loopback)


def _host_of(address: str) -> str:
    """The host of ``//host:port``, in small letters and without brackets; empty if there is none."""
    try:
        return (urlsplit(address).hostname or "").lower()
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def policy(page: str) -> str:
    """The Content-Security-Policy of a page: the scripts and styles that it holds, and its own server."""
    kinds = {}
    for tag in ("script", "style"):
        texts = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        hashes = (base64.b64encode(hashlib.sha256(t.encode()).digest()).decode() for t in texts)
        kinds[tag] = " ".join(f"'sha256-{h}'" for h in hashes)
    return (
        f"default-src 'none'; script-src {kinds['script']}; style-src {kinds['style']}; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


# ── what the clients have ────────────────────────────────────────────────────────────────────────────


class Sections:
    """The newest text of every section, with a number that grows whenever one changes."""

    def __init__(self) -> None:
        self.newest = 0
        self._texts: dict[str, tuple[int, str]] = {}

    def take(self, name: str, value: Any) -> None:
        """Take a section."""
        text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
        if self._texts.get(name, (0, ""))[1] != text:
            self.newest += 1
            self._texts[name] = (self.newest, text)

    def since(self, number: int) -> str:
        """A JSON object of all sections that are newer than ``number``."""
        return "{" + ",".join(f'"{n}":{t}' for n, (k, t) in self._texts.items() if k > number) + "}"


class PageServer(Generic[T]):
    """Serves one page.

    Args:
        page: The page.
        access: Who may come.
        changed: Names of sections that differ between two states (the first may be ``None``), each with what
            makes its plain values.
        press: Called in the server's thread when a button is pressed.
        reports: Folder of the reports; ``None`` if none are shown.
        say: Called in the server's thread with a line for the log.
    """

    def __init__(
        self,
        page: str,
        access: Access,
        changed: Callable[[T | None, T], Iterable[tuple[str, Callable[[], Any]]]],
        press: Press,
        reports: Path | None = None,
        say: Callable[[str], None] = print,
    ) -> None:
        try:
            from aiohttp import web
        except ImportError:
            advice = "install aiohttp: pip install 'calib_planner[page]', or apt install python3-aiohttp"
            raise CalibPlannerError(f"the page needs aiohttp: {advice}") from None
        self._web, self._body, self._policy = web, page.encode(), policy(page)
        self._access, self._changed, self._press, self._reports, self._say = access, changed, press, reports, say
        self._sections = Sections()
        self._shown: T | None = None
        self._next: T | None = None
        self._due = threading.Lock()  # held from the first new state until the loop takes the newest
        self._clients: set[Any] = set()
        self.port = 0

    # ── from the node's threads ──────────────────────────────────────────────────────────────────────

    def start(self, host: str, port: int) -> str:
        """Begin to serve; returns the address to open.

        Raises:
            InputError: The port is in use, or there is no such host.
        """
        self._loop = asyncio.new_event_loop()
        begun: Future[int] = Future()
        self._thread = threading.Thread(target=self._serve, args=(host, port, begun), daemon=True, name="page")
        self._thread.start()
        try:
            self.port = begun.result()
        except OSError as error:
            self._thread.join(PATIENCE)
            reason, advice = f"{host}:{port} ({error.strerror or error})", "choose another port, or 0 for any"
            raise InputError("port", reason, "an address of this machine that is free", advice) from None
        name = socket.gethostname() if host in ("0.0.0.0", "::", "") else host
        name = f"[{name}]" if ":" in name else name
        return f"http://{name}:{self.port}/" + (f"?token={self._access.token}" if self._access.token else "")

    def show(self, state: T) -> None:
        """Show a state; of several the newest counts."""
        self._next = state
        if self._due.acquire(blocking=False):
            try:
                self._loop.call_soon_threadsafe(self._take)
            except RuntimeError:  # it has ended
                return

    @property
    def clients(self) -> int:
        """How many pages are open."""
        return len(self._clients)

    def close(self) -> bool:
        """End it; returns whether it ended in time."""
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(PATIENCE)
        return not self._thread.is_alive()

    # ── in the server's thread ───────────────────────────────────────────────────────────────────────

    def _serve(self, host: str, port: int, begun: Future[int]) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._run(host, port, begun))
        except BaseException as error:
            if begun.done():
                self._say(f"the page's server has ended: {error!r}")
            else:
                begun.set_exception(error)
        finally:
            self._loop.close()

    async def _run(self, host: str, port: int, begun: Future[int]) -> None:
        web = self._web
        self._news, self._end = asyncio.Condition(), asyncio.Event()
        app = web.Application(middlewares=[self._guard()], client_max_size=LARGEST_REQUEST)
        app.router.add_get("/", self._on_page)
        app.router.add_get("/live", self._on_live)
        app.router.add_post("/do/{name}", self._on_button)
        app.router.add_get("/report/{name}", self._on_report)
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.5)
        await runner.setup()
        try:
            site = web.TCPSite(runner, host or None, port)
            await site.start()
            begun.set_result(runner.addresses[0][1])
            await self._end.wait()
            async with self._news:
                self._news.notify_all()
            for client in list(self._clients):
                with suppress(Exception):
                    await asyncio.wait_for(client.close(code=1001, message=b"the node ends"), 0.5)
        finally:
            await runner.cleanup()

    def _take(self) -> None:
        """Make the sections of the newest state, and wake the clients."""
        self._due.release()
        state = self._next
        if state is None or state is self._shown:
            return
        before = self._sections.newest
        for name, make in self._changed(self._shown, state):
            try:
                self._sections.take(name, make())
            except Exception as error:  # a fault of ours in one of them must not end the page
                self._say(f"{name} is not shown: {error!r}")
        self._shown = state
        if self._sections.newest > before:
            self._loop.create_task(self._wake())

    async def _wake(self) -> None:
        async with self._news:
            self._news.notify_all()

    def _guard(self) -> Any:
        web, access = self._web, self._access

        @web.middleware  # type: ignore[untyped-decorator, unused-ignore]
        async def guard(request: Any, handler: Any) -> Any:
            """Refuse who may not come, before anything else is looked at; add the headers that browsers heed."""
            called = request.headers.get("Host", "")
            reason = access.wrong_host(called)
            if not reason and (request.method != "GET" or request.path == "/live"):
                reason = access.wrong_origin(request.headers.get("Origin"), called)
            if (
                not reason
                and request.headers.get("Sec-Fetch-Site", "none") == "cross-site"
                and request.path != "/"
            ):
                reason = access.wrong_origin("another site", called)
            given = request.query.get("token")
            cookie = f"calib_page_{self.port}"
            entering = access.token and given is not None and request.path == "/"
            if not reason and entering and not access.wrong_token(given):
                answer = web.Response(status=303, headers={"Location": "/"})
                answer.set_cookie(cookie, given, httponly=True, samesite="Strict", max_age=30 * 86400)
            elif reason or (reason := access.wrong_token(request.cookies.get(cookie))):
                answer = web.Response(status=403, text=f"Refused: {reason}.\n")
            else:
                try:
                    answer = await handler(request)
                except web.HTTPException as error:
                    answer = web.Response(status=error.status, text=f"{error.status}: {error.reason}\n")
            if not answer.prepared:
                for name, value in SAFE.items():
                    answer.headers.setdefault(name, value)
                answer.headers.setdefault("Content-Security-Policy", "default-src 'none'; frame-ancestors 'none'")
            return answer

        return guard

    async def _on_page(self, request: Any) -> Any:
        # Some browsers do not count a WebSocket as 'self'.
        source = self._policy.replace("connect-src 'self'", f"connect-src 'self' ws://{request.headers['Host']}")
        headers = {"Content-Security-Policy": source}
        return self._web.Response(body=self._body, content_type="text/html", charset="utf-8", headers=headers)

    async def _on_live(self, request: Any) -> Any:
        """Send what is new until the client goes; what it sends is not read."""
        web = self._web
        if len(self._clients) >= MOST_CLIENTS:
            return web.Response(status=503, text=f"{MOST_CLIENTS} pages are open: close some.\n")
        client = web.WebSocketResponse(
            timeout=FAREWELL, heartbeat=SILENCE, max_msg_size=LARGEST_REQUEST, compress=False
        )
        self._clients.add(client)
        sending = None
        try:
            await client.prepare(request)
            sending = self._loop.create_task(self._send(client, request))
            async for _ in client:
                break  # a client of ours says nothing
        finally:
            self._clients.discard(client)
            _drop(request)
            if sending is not None:
                sending.cancel()  # before Python 3.12 wait_for may lose it: therefore the loop looks at _clients
                with suppress(asyncio.CancelledError, Exception):
                    await sending
        return client

    async def _send(self, client: Any, request: Any) -> None:
        has = -1
        try:
            while client in self._clients and not client.closed and not self._end.is_set():
                with suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(self._newer(has), PULSE)
                if self._end.is_set():
                    return
                text, has = self._sections.since(has), self._sections.newest
                await asyncio.wait_for(client.send_str(text), SILENCE)
                await asyncio.sleep(PERIOD)
        except (asyncio.TimeoutError, ConnectionError):
            _drop(request)

    async def _newer(self, has: int) -> None:
        async with self._news:
            await self._news.wait_for(lambda: self._sections.newest > has or self._end.is_set())

    async def _on_button(self, request: Any) -> Any:
        web = self._web
        if request.content_type != "application/json":
            return web.json_response({"done": False, "text": "this is no JSON"}, status=415)
        try:
            values = await request.json()
        except ValueError:
            values = None
        if not isinstance(values, dict):
            return web.json_response({"done": False, "text": "this is no JSON object"}, status=400)
        try:
            answer = await asyncio.wrap_future(self._press(request.match_info["name"], values))
        except CalibPlannerError as error:
            return web.json_response({"done": False, "text": str(error)}, status=400)
        return web.json_response({"done": answer.done, "text": answer.text})

    async def _on_report(self, request: Any) -> Any:
        """A report of the folder itself; a name that leads anywhere else is not found."""
        name = request.match_info["name"]
        if self._reports is None or not REPORT.fullmatch(name):
            raise self._web.HTTPNotFound
        path = self._reports / name
        try:
            if path.is_symlink() or not path.is_file():
                raise self._web.HTTPNotFound
            body = await self._loop.run_in_executor(None, path.read_bytes)
        except OSError:
            raise self._web.HTTPNotFound from None
        headers = {"Content-Security-Policy": SANDBOX}
        return self._web.Response(body=body, content_type="text/html", charset="utf-8", headers=headers)


def _drop(request: Any) -> None:
    """End a connection at once, with what waits to be sent."""
    if request.transport is not None:
        request.transport.abort()
