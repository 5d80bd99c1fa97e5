"""Access control of the web server of the flight viewer, `view.py`.

Requests from pages of other sites in the same browser are rejected: the origin of a request must be
the server itself, under one of its own host names. If the server listens on another address than
the loopback address, every request also needs the token, in its address or, after the first page,
in a cookie. Traffic is not encrypted: whoever can read the network traffic can read the token.
Across networks use a tunnel such as `ssh -L`.

The viewer's library viser has no setting for access control. Therefore the function that starts its
web server is replaced while the server is created.
"""

import contextlib
import hmac
import http
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import parse_qs, urlsplit

_COOKIE = "planner-jax"
_OWN = {"localhost", "127.0.0.1", "::1"}


def is_allowed(headers: Any, path: str, names: set[str], token: str | None) -> bool:
    """Return whether the viewer's web server may answer a request.

    Args:
        headers: headers of the request.
        path: path of the request, with its query.
        names: host names of this machine.
        token: token that the request must contain, or None if no token is needed.
    """
    here = headers.get("Host", "")
    if token is None and urlsplit(f"//{here}").hostname not in names | _OWN:
        return False
    origin = headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != here:
        return False
    if token is None:
        return True
    cookies = dict(
        each.strip().partition("=")[::2] for each in headers.get("Cookie", "").split(";")
    )
    given = [*parse_qs(urlsplit(path).query).get("token", []), cookies.get(_COOKIE, "")]
    return any(hmac.compare_digest(each.encode(), token.encode()) for each in given)


@contextlib.contextmanager
def guard_server(names: set[str], token: str | None) -> Iterator[Callable[[], bool]]:
    """Make web servers that start inside this context reject requests unless `is_allowed`.

    Yields:
        A function that returns whether a server has been started.
    """
    from websockets.asyncio import server

    started, plain = [], server.serve

    def serve(*arguments: Any, process_request: Any = None, **how: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            if not is_allowed(request.headers, request.path, names, token):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "not allowed\n")
            answer = process_request(connection, request) if process_request else None
            if token is not None and answer is not None:
                cookie = f"{_COOKIE}={token}; Path=/; HttpOnly; SameSite=Strict"
                answer.headers["Set-Cookie"] = cookie
            return answer

        started.append(True)
        return plain(*arguments, process_request=process, **how)

    server.serve = serve  # type: ignore[assignment, misc]
    try:
        yield lambda: bool(started)
    finally:
        server.serve = plain  # type: ignore[misc]
