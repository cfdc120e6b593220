"""Answers that no route makes: problem documents, refused ranges of a file, and hosts this service is not."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping

from fastapi.responses import FileResponse, JSONResponse
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from sidelong_service.problems import MEDIA_TYPE, Problem, problem


def answer(trouble: Problem, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """Return the HTTP answer that carries a problem."""
    given = dict(headers or {})
    if trouble.retryable and trouble.status == 503:
        given["Retry-After"] = "1"
    content = trouble.model_dump(mode="json", exclude_none=True)
    return JSONResponse(content, trouble.status, given, media_type=MEDIA_TYPE)


class ArtifactFile(FileResponse):
    """A file whose refusals of a ``Range`` are problem documents, as all others are."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the file, or the asked range of it."""
        refused = False

        async def send_or_refuse(message: Message) -> None:
            nonlocal refused
            if message["type"] == "http.response.start" and message["status"] in (400, 416):
                refused = True
                asked = Headers(scope=scope).get("range", "")
                kind = "bad-request" if message["status"] == 400 else "range"
                trouble = problem(kind, f"Range: {asked!r:.80} of {self.headers['content-length']} bytes")
                told = Headers(raw=message["headers"])
                kept = {name: told[name] for name in ("content-range",) if name in told}
                await answer(trouble, kept)(scope, receive, send)
            elif not refused:
                await send(message)

        await super().__call__(scope, receive, send_or_refuse)


class LocalHosts:
    """Refuses requests for any host name but this machine's: a web page whose name was pointed here has another one.

    An address in the place of a name is no such page, whatever the address.
    """

    def __init__(self, app: ASGIApp, host: str) -> None:
        self._app = app
        self._names = {"localhost", host.lower()}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] == "http":
            asked = Headers(scope=scope).get("host", "localhost")
            if not self._is_here(asked):
                await answer(problem("host", f"Host: {asked!r:.80} is neither an address nor localhost"))(
                    scope, receive, send
                )
                return
        await self._app(scope, receive, send)

    def _is_here(self, asked: str) -> bool:
        """Tell whether a Host header, with or without a port, names this machine."""
        name = asked[1:].partition("]")[0] if asked.startswith("[") else asked.partition(":")[0]
        if name.lower() in self._names:
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True
