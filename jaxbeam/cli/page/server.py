"""Thin server of the page: loopback only, a token for each question, JSON or arrays out."""

import hmac
import secrets
import socket
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from jaxbeam.cli.page.questions import Content, answer, as_json, problem_of, questions
from jaxbeam.cli.page.workspace import MAX_BYTES, Workspace
from jaxbeam.model.plausibility.check import leave_warnings_to_caller

STATIC = Path(__file__).parent / "static"
LOOPBACK = "127.0.0.1"
LOG_PATH, MAX_LOG_BYTES = "/api/log", 64 * 2**20
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self';"
    " img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none';"
    " frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


class Guard:
    """Middleware that refuses requests of other pages: other hosts, other origins, no token.

    The `Host` is compared against rebinding of names, the `Origin` and `Sec-Fetch-Site` against
    other pages in the same browser. Bodies above the limit are refused before they are read.
    """

    def __init__(self, app: Any, token: str, port: int):
        self._app, self._token = app, token
        self._hosts = {f"{name}:{port}" for name in (LOOPBACK, "localhost")}

    async def __call__(self, scope, receive, send) -> None:
        """Answer a question, or refuse it."""
        if scope["type"] != "http":
            return
        request = Request(scope)
        refusal = self._refusal(request)
        if refusal is not None:
            await JSONResponse({"problem": {"message": refusal[1]}}, refusal[0], HEADERS)(
                scope, receive, send
            )
            return
        received, most = 0, _most_bytes(request)

        async def limited():
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > most:  # of a body without a stated length
                return {"type": "http.disconnect"}
            return message

        async def with_headers(message):
            if message["type"] == "http.response.start":
                own = {name.decode().lower() for name, _ in message["headers"]}
                message["headers"] += [
                    (name.encode(), value.encode())
                    for name, value in HEADERS.items()
                    if name not in own
                ]
            await send(message)

        await self._app(scope, limited, with_headers)

    def _refusal(self, request: Request) -> tuple[int, str] | None:
        """Status and sentence for a request that is refused; None for one that is allowed."""
        headers = request.headers
        host = headers.get("host", "")
        if host not in self._hosts:
            return 403, "this page is there for this machine only"
        origin = headers.get("origin")
        if origin is not None and origin != f"http://{host}":
            return 403, "another page may not ask here"
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            return 403, "another page may not ask here"
        if request.url.path.startswith("/static/"):
            return None  # the page's own code: no one's data
        given = headers.get("x-token") or request.query_params.get("token", "")
        if not hmac.compare_digest(given.encode(), self._token.encode()):
            return 403, "open the address that `jaxbeam app` has printed, with its token"
        length = headers.get("content-length", "0")
        most = _most_bytes(request)
        if not length.isdigit() or int(length) > most:
            return 413, f"this is more than the {most >> 20} MB that the page takes"
        return None


def _most_bytes(request: Request) -> int:
    """Largest size (bytes) of a request: logs may be longer than cases."""
    return MAX_LOG_BYTES if request.url.path == LOG_PATH else MAX_BYTES


def _response(answered: bool, content: Content) -> Response:
    heads = {}
    if content.name is not None:
        heads["content-disposition"] = f'attachment; filename="{content.name}"'
    return Response(content.body, 200 if answered else 422, heads, content.kind)


def _asked(work: Callable[[dict[str, Any]], Any]) -> Callable[[Request], Any]:
    """Handler of a question: its JSON to the work, in a thread; errors as data."""

    async def respond(request: Request) -> Response:
        return _response(*await run_in_threadpool(answer, work, await request.body()))

    return respond


def application(workspace: Workspace, opened: str | None, token: str, port: int) -> Any:
    """ASGI application of the page of a workspace, whose file `opened` is shown first."""

    def index(_) -> Response:
        return Response((STATIC / "index.html").read_bytes(), media_type="text/html")

    async def log(request: Request) -> Response:
        name, content = unquote(request.headers.get("x-name", "")), await request.body()
        try:
            found = await run_in_threadpool(workspace.take_log, name, content)
        except (ValueError, OSError, ImportError) as error:
            return _response(False, as_json({"problem": problem_of(error)}))
        return _response(True, as_json(found))

    routes = [
        Route("/", index),
        Route(LOG_PATH, log, methods=["POST"]),
        *(
            Route(f"/api/{name}", _asked(work), methods=["POST"])
            for name, work in questions(workspace, opened).items()
        ),
        Mount("/static", StaticFiles(directory=STATIC)),
    ]
    return Guard(Starlette(routes=routes), token, port)


def serve(folder: Path, opened: str | None, port: int, browser: bool) -> None:
    """Serve the page of a folder until it is stopped, and print its address on one line."""
    with socket.socket() as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((LOOPBACK, port))
        port = listening.getsockname()[1]
        token = secrets.token_urlsafe(24)
        address = f"http://{LOOPBACK}:{port}/?token={token}"
        leave_warnings_to_caller()  # the page shows them
        workspace = Workspace(folder)
        app = application(workspace, opened, token, port)
        server = uvicorn.Server(
            uvicorn.Config(
                app,
                log_level="error",
                lifespan="off",
                ws="none",
                server_header=False,
                access_log=False,
                timeout_graceful_shutdown=1,
            )
        )
        listening.listen(64)
        print(address, flush=True)
        if browser:
            webbrowser.open(address)
        try:
            server.run(sockets=[listening])
        finally:
            workspace.close()
