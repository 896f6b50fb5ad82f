"""The driver of the carrier, who follows the route that the localization unit advises."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, sin

from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake_diagrams.forest.world.carrier import quaternion_matrix
from vtbdrake_diagrams.forest.world.routes import Route

# Distance along the route of the point that the driver steers to, in m.
_LOOK_AHEAD = 3.0
# Distance from the route beyond which the driver looks for it again, in m.
_LOST = 2.5
# Two routes are the same road where they are nearer to each other than this, in m.
_SAME_ROAD = 0.2


class Driver(AddressedSystem):
    """A driver who follows the advised route by the true pose, as a human does who sees the road.

    .. pydrake_system::

        name: Driver
        input_ports:
        - state
        - route
        output_ports:
        - controls

    ``state`` has the pose of the body B, as in a plant's [q; v], ``route`` the number of the advised route.
    ``controls`` are the speed (m/s) and the curvature (1/m, to the left) of the path of the middle of the rear axle.
    The curvature follows pure pursuit: of the circle through a point some metres ahead on the route (Coulter,
    "Implementation of the pure pursuit path tracking algorithm", CMU-RI-TR-92-01, 1992).

    The driver changes to the advised route where both routes are the same road (the routes of `strip_roads` begin
    alike). After ``laps`` laps, the driver stops.

    The driver is sampled. State: ``route``, the distance ``along`` it (m), ``lap``, and the controls.
    """

    def __init__(
        self,
        routes: Sequence[Route],
        *,
        size: int,
        start: int,
        wheel_base: float,
        period: float,
        speed: float,
        laps: int,
        route: int = 0,
        along: float = 0.0,
    ) -> None:
        """Declare the driver.

        Args:
            routes: The routes by number.
            size: The size of the port ``state``.
            start: Where quaternion and position (m) of B begin in it.
            wheel_base: Distance of the carrier's axles in m; 0 for a worker on foot.
            period: Sample period in s.
            speed: The speed at which the driver drives, in m/s.
            laps: The number of laps after which the driver stops.
            route: The number of the route on which the drive begins.
            along: The distance from the beginning of this route at which the drive begins, in m.
        """
        super().__init__()
        self._routes, self._laps, self._rear = tuple(routes), int(laps), wheel_base / 2.0
        self._q = start
        self._state = self.DeclareVectorInputPort("state", size)
        self._advice = self.DeclareVectorInputPort("route", 1)
        self._progress = self.declare_discrete_state(
            route=Quantity(route, bounds=(0.0, len(self._routes) - 1.0)), along=Quantity(along, "m"), lap=Quantity(0.0)
        )
        self._controls = self.declare_discrete_state(
            wanted_speed=Quantity(0.0, "m/s"), wanted_curvature=Quantity(0.0, "1/m")
        )
        self.DeclareStateOutputPort("controls", self._controls.index)
        self._settings = self.declare_parameters(speed=Quantity(speed, "m/s", (0.0, 3.0)))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        progress, controls = self._progress.mutable(state), self._controls.mutable(state)
        x = self._state.Eval(context)[self._q : self._q + 7]
        forward = quaternion_matrix(x[:4])[:2, 0]
        forward = forward / hypot(*forward.tolist())
        place = x[4:6] - self._rear * forward

        number = self._next_route(int(progress.route), progress.along, self._advice.Eval(context).item(0))
        route = self._routes[number]
        heading = route.heading(progress.along)
        off = place - route.position(progress.along)
        if hypot(*off.tolist()) > _LOST:
            progress.along = route.nearest(place)
        else:
            progress.along += float(off @ (cos(heading), sin(heading)))
        if progress.along >= route.length:
            progress.along -= route.length
            progress.lap += 1.0
        progress.route = number
        ahead = route.position(progress.along + _LOOK_AHEAD) - place
        sideways = forward[0] * ahead[1] - forward[1] * ahead[0]
        controls.wanted_speed = 0.0 if progress.lap >= self._laps else self._settings.view(context).speed
        controls.wanted_curvature = 2.0 * float(sideways) / float(ahead @ ahead)

    def _next_route(self, present: int, along: float, advised: float) -> int:
        """Return the number of the route to follow from here."""
        number = min(max(round(advised), 0), len(self._routes) - 1)
        if number == present:
            return present
        apart = self._routes[number].position(along) - self._routes[present].position(along)
        return number if hypot(*apart.tolist()) < _SAME_ROAD else present
