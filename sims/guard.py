"""Who may look at the viewer: pages of its own origin, and beyond this machine who has the token.

Viser has no setting for either, so that the function with which it begins to serve is wrapped while
it does: a page of another site in the same browser cannot reach the web socket, and neither can one
that calls this machine by another name. Beyond the loopback address every request has to carry the
token, in its address or, after the first page, in a cookie. What is sent is not encrypted, and who
reads the traffic of a network reads the token: across networks use a tunnel such as `ssh -L`.
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
    """Whether a request may be answered.

    Args:
        headers: of the request.
        path: of the request, with its query.
        names: under which the machine is called.
        token: that is asked for, or None.
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
    """A block in which what begins to serve answers allowed requests only.

    Yields a function that says whether something has begun to.
    """
    from websockets.asyncio import server

    begun, plain = [], server.serve

    def serve(*arguments: Any, process_request: Any = None, **how: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            if not is_allowed(request.headers, request.path, names, token):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "not allowed\n")
            answer = process_request(connection, request) if process_request else None
            if token is not None and answer is not None:
                kept = f"{_COOKIE}={token}; Path=/; HttpOnly; SameSite=Strict"
                answer.headers["Set-Cookie"] = kept
            return answer

        begun.append(True)
        return plain(*arguments, process_request=process, **how)

    server.serve = serve  # type: ignore[assignment, misc]
    try:
        yield lambda: bool(begun)
    finally:
        server.serve = plain  # type: ignore[misc]
