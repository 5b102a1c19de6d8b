"""The routes of the console, with the role and the body size that each route accepts.

The guard looks a request up here before any of its body is read.
"""

import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fastapi import APIRouter
from fastapi.routing import APIRoute
from starlette.routing import BaseRoute, Match
from starlette.types import Scope

from heliotrope.calibration.flights import FlightDocument
from heliotrope.console.auth import AtLeast, caller
from heliotrope.plant.interface.orders import PlantFileText
from heliotrope.plant.orders.authority import Role

#: Largest body, bytes: from a stranger or if none is expected; of a form; of points or names for
#: every heliostat of the largest field.
TINY, FORM, LARGEST = 4096, 1 << 14, 16 << 20
#: The same with the text of a plant file, whatever the size of the field.
FILE = 1 << 20
#: The same per heliostat of a plant, bytes: the longest name, and a point with all its digits.
EACH = 160
#: The same for a drone flight: 20 orientations with the errors that they share.
EACH_FLOWN = 1 << 14
READ = ("GET", "HEAD")


@dataclass(frozen=True)
class RouteMatch:
    """The route of a request.

    Attributes
    ----------
    status
        200, or 404 or 405 if there is no such route.
    role
        Minimum role; None if the route is open to all.
    largest, per_heliostat
        Largest body, and size allowed per heliostat of the plant beyond `form`, bytes.
    form
        Size allowed whatever the number of heliostats, bytes.
    allow
        Methods available for the path.
    """

    status: int
    role: Role | None = None
    largest: int = TINY
    per_heliostat: int = EACH
    form: int = FORM
    allow: tuple[str, ...] = ()


class Routes:
    """Finds the route of a request.

    Parameters
    ----------
    routers
        Routers of the API.
    files
        Read-only paths that are open to all.
    own
        Further read-only paths, with the minimum role.
    """

    def __init__(
        self, routers: Sequence[APIRouter], files: Iterable[str], own: Mapping[str, Role]
    ) -> None:
        self._api = [(route, _of(route)) for router in routers for route in router.routes]
        self._files, self._own = frozenset(files), dict(own)

    def find(self, scope: Scope) -> RouteMatch:
        """Return the route of a request."""
        path, method = scope["path"], scope["method"]
        if path in self._files or path in self._own:
            result = RouteMatch(200, self._own.get(path))
            return result if method in READ else RouteMatch(405, allow=READ)
        allow: list[str] = []
        for route, result in self._api:
            match, _ = route.matches({**scope, "type": "http"})
            if match is Match.FULL:
                return result
            if match is Match.PARTIAL:
                allow += sorted(getattr(route, "methods", ()))
        return RouteMatch(405, allow=tuple(allow)) if allow else RouteMatch(404)


def _of(route: BaseRoute) -> RouteMatch:
    if not isinstance(route, APIRoute):
        return RouteMatch(404)
    field = route.body_field
    model = None if field is None else field.field_info.annotation
    role = least_role(route.dependant)
    if isinstance(model, type) and issubclass(model, PlantFileText):
        return RouteMatch(200, role, FILE, form=FILE)
    largest = TINY if model is None or role is None else _largest(model)
    return RouteMatch(200, role, largest, EACH_FLOWN if model is FlightDocument else EACH)


def least_role(dependant: Any) -> Role | None:
    """Return the minimum role that a route's dependencies require; None if it is open to all."""
    roles = [least_role(dependency) for dependency in dependant.dependencies]
    if isinstance(dependant.call, AtLeast):
        roles.append(dependant.call.role)
    elif dependant.call is caller:
        roles.append(Role.VIEWER)
    return max((role for role in roles if role is not None), default=None)


def _largest(model: Any) -> int:
    """Return the largest body of a model.

    It is large if the model contains names or points, otherwise it has the size of a form.
    """
    kinds = [model, *typing.get_args(model)]
    fields = [
        field.annotation for kind in kinds for field in getattr(kind, "model_fields", {}).values()
    ]
    many = any(typing.get_origin(field) in (list, dict) for field in fields)
    return LARGEST if many else FORM
