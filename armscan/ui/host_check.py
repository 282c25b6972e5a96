"""Protection of local servers: allowed hosts, and a sandbox for the files that they serve."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from wsgiref.types import StartResponse, WSGIApplication, WSGIEnvironment

# `Sec-Fetch-Site` of requests from other origins, some of which browsers send without asking the server first.
FROM_ELSEWHERE = ("cross-site", "same-site")
SAFE_METHODS = ("GET", "HEAD")
# Headers for files that anybody may have put into a study: no script in them runs, and no type is guessed.
ARTIFACTS, SANDBOX = "/artifacts/", (("Content-Security-Policy", "sandbox"), ("X-Content-Type-Options", "nosniff"))


class HostCheck:
    """WSGI middleware that refuses requests for other hosts and from other origins, and sandboxes artifacts.

    Without it, any web page could read and delete studies, by DNS rebinding. MLflow's server has the same check.

    Args:
        application: WSGI application to protect.
        hosts: Patterns of allowed Host headers, `NAME:PORT`; `*` matches any text.
    """

    def __init__(self, application: WSGIApplication, hosts: Sequence[str]) -> None:
        self._application, self._hosts = application, tuple(hosts)

    def __call__(self, environ: WSGIEnvironment, start_response: StartResponse) -> Iterable[bytes]:
        """Answer a request; 403 if it is refused."""
        if self._is_allowed(environ):
            is_artifact = environ.get("PATH_INFO", "").startswith(ARTIFACTS)
            return self._application(environ, _sandboxed(start_response) if is_artifact else start_response)
        body = f"403: this server is reached only as {', '.join(self._hosts)}, and only from its own pages\n".encode()
        start_response("403 Forbidden", [("Content-Type", "text/plain"), ("Content-Length", str(len(body)))])
        return [body]

    def _is_allowed(self, environ: WSGIEnvironment) -> bool:
        named = [environ.get("HTTP_HOST", "")]
        if "HTTP_ORIGIN" in environ:
            named.append(urlsplit(environ["HTTP_ORIGIN"]).netloc)
        try:
            # Bottle drops bytes that are not UTF-8, so that its path would not be the one checked here.
            environ.get("PATH_INFO", "").encode("latin-1").decode()
        except UnicodeError:
            return False
        is_safe = environ["REQUEST_METHOD"] in SAFE_METHODS
        is_from_elsewhere = not is_safe and environ.get("HTTP_SEC_FETCH_SITE") in FROM_ELSEWHERE
        return not is_from_elsewhere and all(any(fnmatchcase(name, host) for host in self._hosts) for name in named)


def _sandboxed(start_response: StartResponse) -> StartResponse:
    """Return a `start_response` that adds the headers of `SANDBOX`."""

    def start(status: str, headers: list[tuple[str, str]], *error: Any) -> Any:
        return start_response(status, [*headers, *SANDBOX], *error)

    return start
