"""The first page: what is going on."""

from __future__ import annotations

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hil.web.rendering import page


def overview(request: Request) -> Response:
    """What is going on."""
    return page(request, "overview.html.j2", title="Overview")


routes = [Route("/", overview)]
