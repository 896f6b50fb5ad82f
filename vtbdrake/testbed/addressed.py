"""A Diagram with addresses: the base of a testbed, of the DPS alone and of the world alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from pydrake.systems.analysis import InitializeParams, Simulator, SimulatorConfig, SimulatorStatus
from pydrake.systems.framework import Context, Diagram, InputPort, OutputPort, PortDataType, System
from pydrake.systems.primitives import ZeroOrderHold

from vtbdrake.common.argument_checks import suggestion
from vtbdrake.common.failures import FAILURES
from vtbdrake.drake_workarounds.cenic import CenicSimulator
from vtbdrake.drake_workarounds.making import making
from vtbdrake.drake_workarounds.step_watch import StepWatch
from vtbdrake.state import AddressError, Snapshot, SnapshotError, Variable, Variables, collect
from vtbdrake.state import snapshot as snapshots
from vtbdrake.state.layout import StateLayout
from vtbdrake.state.snapshot import StateCopier
from vtbdrake.state.systems import is_plant, is_python, is_scene_graph, leaves, output_ports
from vtbdrake.state.variables import X, check_address
from vtbdrake.testbed.dps_state import DpsReader
from vtbdrake.testbed.integrator import apply_simulator_config, controls_error
from vtbdrake.testbed.signal import Interface
from vtbdrake.testbed.slow_part import SlowPart, slow_parts
from vtbdrake.testbed.switch import BOARD, COMMAND, T_ACT, T_SENSE

if TYPE_CHECKING:
    from vtbdrake.state.geometry import GeometryWatch
    from vtbdrake.testbed.scenario_identity import IdentifiedScenario


_NO_CONTEXT = (
    "this is no context of this testbed, but of another one (or another build, or of a part), or none at all: make one "
    "with default_context(); a snapshot takes a state from one testbed to another"
)


def check_root(diagram: Diagram, context: Context) -> None:
    """Reject a context that is not the root context of a Diagram.

    Args:
        diagram: The Diagram.
        context: What may be its root context.

    Raises:
        ValueError: The context is another Diagram's, or none.
    """
    try:
        diagram.ValidateContext(context)
    except (RuntimeError, TypeError) as error:
        raise ValueError(_NO_CONTEXT) from error


def check_boundary(simulator: Simulator, time: float) -> None:
    """Raise a ValueError if a simulator cannot advance to a time, where Drake would end the process.

    Args:
        simulator: The simulator.
        time: The time in s, which is not before the present one.
    """
    now = simulator.get_context().get_time()
    if not time >= now:
        raise ValueError(f"the simulation is at {now:.9g} s, and cannot advance to {time} s")


class WatchedSimulator(Simulator):
    """Drake's Simulator, which raises a `NoProgressError` where its integrator would shorten a step for ever.

    Args:
        target: The testbed, or the DPS alone.
        context: The root context that it advances.
    """

    def __init__(self, target: AddressedDiagram, context: Context) -> None:
        super().__init__(target.diagram, context)
        self._watch = target.step_watch(self)

    def AdvanceTo(self, boundary_time: float, interruptible: bool = True) -> SimulatorStatus:
        check_boundary(self, boundary_time)
        with self._watch:
            return super().AdvanceTo(boundary_time, interruptible)


class AddressedDiagram:
    """A Diagram with addresses for the contents of its Context, and with the settings of its simulation.

    It is not a subclass of Diagram: Drake would then look for Python overrides in every step of a simulation.

    Args:
        diagram: The Diagram.
        interface: The signals of the DPS.
        simulator_config: The settings of its integration.
        scenario: The scenario that built it, or None.
        extra: Variables beside the ones of the systems.
        by_demand: Functions that make variables which are not listed, by address.
        plant_roles: ``sys`` or ``env``, by model instance of the plant.
    """

    def __init__(
        self,
        *,
        diagram: Diagram,
        interface: Interface,
        simulator_config: SimulatorConfig,
        scenario: IdentifiedScenario | None,
        extra: Iterable[Variable] = (),
        by_demand: Mapping[str, Callable[[], Variable]] | None = None,
        plant_roles: Mapping[str, str] | None = None,
    ) -> None:
        """Collect the variables of ``diagram``; ``plant_roles`` maps model instances to ``sys`` or ``env``."""
        roles = plant_roles or {}
        clock = Variable("time", X, (), "s", lambda context: context.get_time())
        self.diagram = diagram  # its input and output ports carry the DPS's signals
        self.interface = interface  # the DPS's signals
        self.simulator_config = simulator_config  # settings of its integration
        self.scenario = scenario  # the scenario that built it, or None
        self._geometry = _geometry_watch(diagram)
        self._variables = collect(
            diagram,
            plant_prefix=lambda path, instance: f"sim.{roles[instance]}" if path == "plant" else path,
            skip=lambda path: path == BOARD or path.startswith((T_SENSE, T_ACT)),
            extra=[clock, *extra],
            by_demand=by_demand,
        )
        self._defaults = self._defaults_of(scenario)
        self._sampling = _sampling_part(diagram)
        if self._sampling is not None:
            self._sampling.sample_dps_by(self.dps_state)

    def _defaults_of(self, scenario: IdentifiedScenario | None) -> dict[str, float]:
        """Return the values of the scenario's pedigree for this side: DPS, world or both.

        Raises:
            ValueError: There is no such variable, or it does not take the value.
        """
        sides = {address.partition(".")[0] for address in self._variables}
        values = {} if scenario is None else scenario.pedigree.values
        defaults = {address: value for address, value in values.items() if address.partition(".")[0] in sides}
        for address, value in defaults.items():
            try:
                self._variables[address].check(value)
            except ValueError as error:
                raise ValueError(f"the pedigree of {scenario!r}: {error}") from error
        return defaults

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.scenario!r}, {len(self._variables)} variables)"

    def __reduce__(self) -> NoReturn:
        raise TypeError(f"a {type(self).__name__} cannot be pickled or copied: send its scenario, and build it there")

    # -- contexts and simulators

    def default_context(self) -> Context:
        """Return a new context: s0 from defaults."""
        with making():
            context = self.diagram.CreateDefaultContext()
        if self._geometry is not None:
            self._geometry.remember(context)
        if self.simulator_config.use_error_control:
            # By the accuracy, Drake finds the times of events that depend on the state, such as a foot that lands.
            context.SetAccuracy(self.simulator_config.accuracy)
        if self._defaults:
            self._variables.write(context, self._defaults)
        self.attach(context)
        return context

    def attach(self, context: Context) -> None:
        """Give the slow part that samples the state of the DPS access to it, as `default_context` and `simulator` do.

        Call it for a context that was made in another way: a Clone, or the context of a Diagram around this one.
        Without such a slow part, nothing happens.

        Args:
            context: A root context of this diagram, or of a diagram that holds it.
        """
        if self._sampling is not None:
            self._sampling.attach(context)

    def check_context(self, context: Context) -> None:
        """Reject a context that is not the root context of this diagram, or of a diagram that holds it.

        Raises:
            ValueError: The context is another diagram's, or a subsystem's.
        """
        self._own_context(context)

    def _own_context(self, context: Context) -> Context:
        """Return ``context``, or the part of it that belongs to this diagram in one that holds it."""
        try:
            return self._validated(context)
        except (RuntimeError, TypeError) as error:
            raise ValueError(_NO_CONTEXT) from error

    def _validated(self, context: Context) -> Context:
        try:
            # pydrake keeps a context alive for ever if it is the result of GetMyContextFromRoot on itself.
            self.diagram.ValidateContext(context)
        except (RuntimeError, TypeError):
            context = self.diagram.GetMyContextFromRoot(context)
            self.diagram.ValidateContext(context)
        return context

    def simulator(self, context: Context | None = None, *, restored: bool = False) -> Simulator:
        """Return a new Drake Simulator with the integrator of ``simulator_config``.

        Args:
            context: A context of this diagram; a default one if left out.
            restored: True if ``context`` continues another one: initialization events, which would overwrite its
                state, do not happen again.

        Raises:
            ValueError: ``context`` belongs to another diagram, or to one that holds this one.
        """
        if context is None:
            context = self.default_context()
        if self._own_context(context) is not context:
            raise ValueError(
                "the context belongs to a diagram that holds this testbed's: simulate that diagram, by Simulator(...)"
            )
        self.attach(context)
        simulator = self._bare_simulator(context)
        self._give_integrator(simulator)
        simulator.set_target_realtime_rate(self.simulator_config.target_realtime_rate)
        if restored:
            simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        return simulator

    def _bare_simulator(self, context: Context) -> Simulator:
        if self._can_get_stuck:
            return WatchedSimulator(self, context)
        kind = CenicSimulator if self.simulator_config.integration_scheme == "cenic" else Simulator
        return kind(self.diagram, context)

    @cached_property
    def _can_get_stuck(self) -> bool:
        return controls_error(self.simulator_config) and self.default_context().num_continuous_states() > 0

    def step_watch(self, simulator: Simulator) -> AbstractContextManager[object]:
        """Return a context manager for calls of AdvanceTo; see `StepWatch`. Without a need for one, it does nothing."""
        return StepWatch(simulator, self.reason_for_no_step) if self._can_get_stuck else nullcontext()

    def reason_for_no_step(self, context: Context) -> str:
        """Return the reason why no integration goes on from ``context``: states with time derivatives not finite."""
        begin, state = context.get_time(), context.get_continuous_state_vector().CopyToVector()
        probe = self._own_context(context).Clone()
        # Where the derivatives are finite, they may not be so just behind.
        steps, rates = [0.0, *(max(1.0, abs(begin)) * 2.0 ** np.arange(-52, -3))], np.zeros_like(state)
        with suppress(*FAILURES):
            for step in steps:
                probe.SetTime(begin + step)
                probe.SetContinuousState(state + step * rates)
                derivatives = self.diagram.EvalTimeDerivatives(probe).CopyToVector()
                if not np.isfinite(derivatives).all():
                    names = self._continuous_addresses(np.flatnonzero(~np.isfinite(derivatives)))
                    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
                    return f"the time derivative of {', '.join(names[:3])}{more} is not finite at t = {begin:g} s"
                if step == 0.0:
                    rates = derivatives
        return f"the integrator takes no step that leads further than t = {begin:g} s"

    def _continuous_addresses(self, indices: Iterable[int]) -> list[str]:
        """Return the addresses of entries of the continuous state."""
        context, names = self.default_context(), dict[str, None]()
        state = context.get_continuous_state_vector().CopyToVector()
        for index in indices:
            context.SetContinuousState(np.where(np.arange(state.size) == index, np.nan, state))
            for address, variable in self._variables.items():
                with suppress(*FAILURES):
                    if not variable.derived and np.isnan(variable.get(context)).any():
                        names[address] = None
        return list(names) or ["a continuous state"]

    def _give_integrator(self, simulator: Simulator) -> None:
        # The config would set the time and the pace, too.
        time, pace = simulator.get_context().get_time(), simulator.get_target_realtime_rate()
        apply_simulator_config(self.simulator_config, simulator)
        simulator.get_mutable_context().SetTime(time)
        simulator.set_target_realtime_rate(pace)

    def fork(self, simulator: Simulator) -> Snapshot:
        """Return s(t) of a running simulation, from which a new simulation continues exactly as the running one.

        An integrator with error control remembers its last step, which no snapshot can hold: rollouts from a plain
        `snapshot` begin with a first step of another size, and differ by about the integrator's accuracy, more if
        contact amplifies the difference. After a fork the running simulation continues with a new integrator, too. Its
        future is then equal, to the last bit, to a rollout from the snapshot (``Problem(start=...)``), or to a
        simulation by ``simulator(context, restored=True)`` of a restored context, if both are advanced to the same
        instants: where a call of AdvanceTo ends, a step ends. For a rollout these are `RolloutTask.instants`. With a
        discrete plant or fixed steps, a plain snapshot suffices. Values that are fixed at input ports are no state, and
        are not part of the snapshot.

        Args:
            simulator: A simulator of this testbed, between two calls of its AdvanceTo. (Before Initialize, the
                initialization events would happen in neither simulation; after AdvancePendingEvents, the updates of the
                present instant would happen again in both.)

        Raises:
            ValueError: ``simulator`` is no Simulator, or one of another Diagram.
        """
        if not isinstance(simulator, Simulator):
            raise ValueError(f"fork a simulator made by testbed.simulator(), not {simulator!r}")
        if simulator.get_system() is not self.diagram:
            raise ValueError("the simulator to be forked is of another Diagram: make it by testbed.simulator()")
        snapshot = self.snapshot(simulator.get_context())
        self._give_integrator(simulator)
        simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        return snapshot

    @cached_property
    def dps_state(self) -> DpsReader:
        """Return the reader of the DPS's state: a function of a root context."""
        dps = self.diagram.GetSubsystemByName("dps")
        commands = {a.removeprefix(COMMAND): v.get for a, v in self._variables.items() if a.startswith(COMMAND)}
        sensors = {s.name: (dps, dps.GetInputPort(s.name)) for s in self.interface.sense if s.is_vector}
        return DpsReader(self.dps_layout, commands, sensors)

    def event_timings(self) -> tuple[tuple[float, float], ...]:
        """Return (period, offset) in seconds of the periodic updates of all systems, each pair once.

        The n-th update is at offset + n * period. Drake tells the timing of a system with one kind of discrete updates.
        That of discrete plants and of holds is known, too; of other unrestricted updates, and of several updates, it is
        what the system has in an attribute ``timings``, pairs like these. An `AddressedSystem` fills it by itself.
        """
        systems = [system for _, system in leaves(self.diagram)]
        attributes = (system.GetUniquePeriodicDiscreteUpdateAttribute() for system in systems)
        timings = {(a.period_sec(), a.offset_sec()) for a in attributes if a is not None}
        for system in systems:
            timings.update(getattr(system, "timings", ()))
            if is_plant(system) and system.time_step() > 0.0:
                timings.add((system.time_step(), 0.0))
            elif isinstance(system, ZeroOrderHold):  # An abstract value has an unrestricted update.
                timings.add((system.period(), system.offset()))
        return tuple(sorted(timings))

    # -- addresses

    def variables(self) -> Variables:
        """Return every element of s = [x, a], by address."""
        return self._variables

    def read(self, context: Context, address: str) -> Any:
        """Return the value of a variable, or of a port, in ``context``; see `reader`.

        Args:
            context: A root context of the Diagram.
            address: Address of a variable, of an output port (``path.port``), or ``real.sense.<signal>``.
        """
        self.check_context(context)
        return self.reader(address)(context)

    def write(self, context: Context, values: Mapping[str, Any]) -> None:
        """Set variables in ``context``: all of ``values`` (address -> value), or none.

        Args:
            context: A root context of the Diagram, which is changed.
            values: Values by address, in the variables' units.

        Raises:
            ValueError: There is no such variable, or it does not take the value; nothing has been set.
        """
        self.check_context(context)
        self._variables.write(context, values)

    def reader(self, address: str) -> Callable[[Context], Any]:
        """Return a function that reads a variable or a port from any context.

        Args:
            address: The address of a variable, or of an output port (``path.port``), or ``real.sense.<signal>``, whose
                value is NaN (or None, if it is abstract) while nothing has been received there.

        Raises:
            AddressError: There is no such variable and no such port.
        """
        check_address(address)
        if address in self._variables:
            return self._variables[address].get
        if address in self._ports:
            system, output = self._ports[address]
            return _port_reader(output, self._own_context if system is self.diagram else system.GetMyContextFromRoot)
        if address in self._inputs:
            return self._input_reader(self._inputs[address])
        raise AddressError(f"there is no variable and no port {address!r}{suggestion(address, self.addresses())}")

    def bound_reader(self, context: Context, address: str) -> Callable[[], Any]:
        """Return a function that reads a variable or a port of one context, more quickly than a function of `reader`.

        Args:
            context: The root context, which is read at each call.
            address: As for `reader`.

        Raises:
            AddressError: There is no such variable and no such port.
        """
        if address in self._ports and address not in self._variables:
            system, port = self._ports[address]
            if port.get_data_type() == PortDataType.kVectorValued and system is not self.diagram:
                port_context = system.GetMyContextFromRoot(context)
                return lambda: np.array(port.Eval(port_context))
        return partial(self.reader(address), context)

    def addresses(self) -> list[str]:
        """Return the addresses of everything that can be read: variables, output ports, and ports ``real.sense.*``."""
        return [*self._variables, *self._ports, *self._inputs]

    def _input_reader(self, port: InputPort) -> Callable[[Context], Any]:
        if port.get_data_type() == PortDataType.kVectorValued:
            nothing = np.full(port.size(), np.nan)

            def read_vector(context: Context) -> np.ndarray:
                port_context = self._own_context(context)
                return np.array(port.Eval(port_context) if port.HasValue(port_context) else nothing)

            return read_vector

        def read(context: Context) -> Any:
            value = self.diagram.EvalAbstractInput(self._own_context(context), port.get_index())
            return None if value is None else value.Clone().get_value()

        return read

    @cached_property
    def _ports(self) -> dict[str, tuple[System, OutputPort]]:
        return output_ports(self.diagram)

    @cached_property
    def _inputs(self) -> dict[str, InputPort]:
        ports = [self.diagram.get_input_port(i) for i in range(self.diagram.num_input_ports())]
        return {port.get_name(): port for port in ports if port.get_name().startswith("real.sense.")}

    # -- s(t) as a whole

    def snapshot(self, context: Context) -> Snapshot:
        """Return s(t) as named arrays.

        Args:
            context: A root context of this diagram, or of a diagram that holds it.

        Raises:
            SnapshotError: Something in it cannot be part of a snapshot: an abstract value that its codec refuses, or
                geometry that was changed in this context.
        """
        self.check_context(context)
        if self._geometry is not None:
            self._geometry.check(context)
        record = self.scenario.record() if self.scenario is not None else {}
        return snapshots.take(self.diagram, context, self._variables, scenario=record)

    def check_scenario(self, snapshot: Snapshot) -> None:
        """Raise a SnapshotError if the snapshot is of another scenario, or no snapshot."""
        if not isinstance(snapshot, Snapshot):
            raise SnapshotError(
                f"a state is restored from a Snapshot, such as Snapshot.load(file), not from {snapshot!r}"
            )
        if self.scenario is None or not snapshot.scenario:
            return
        differing = record_differences(snapshot.scenario, self.scenario.record(), where="there")
        differing += self.scenario.order_differences(snapshot.scenario, where="there")
        if differing:
            raise SnapshotError(f"the snapshot is of another scenario ({'; '.join(differing)})")

    def copier_from(self, source: AddressedDiagram) -> StateCopier:
        """Return a copier from contexts of ``source`` to contexts of this diagram.

        Args:
            source: This diagram, or another of the same scenario.
        """
        return StateCopier(source.diagram, source.variables(), self.diagram, self._variables)

    @cached_property
    def dps_layout(self) -> StateLayout:
        """Return the layout of the DPS: its state and its parameters."""
        return StateLayout(self.diagram, state=is_dps, parameters=is_dps)

    @cached_property
    def start_layout(self) -> StateLayout:
        """Return the layout of a start from a belief: all state but the switches, and the DPS's parameters."""
        return StateLayout(self.diagram, state=_is_no_board, parameters=is_dps)

    @cached_property
    def whole_layout(self) -> StateLayout:
        """Return the layout of all state and all parameters, but the switches."""
        return StateLayout(self.diagram, state=_is_no_board, parameters=_is_no_board)

    @cached_property
    def python_systems(self) -> tuple[str, ...]:
        """Return the paths of the systems that are written in Python and have work to do while time runs."""
        # The board of the switches has no work to do.
        return tuple(path for path, system in leaves(self.diagram) if is_python(system) and path != BOARD)


def record_differences(theirs: Mapping[str, Any], mine: Mapping[str, Any], *, where: str) -> list[str]:
    """Return the differences of two records of scenarios as phrases; ``where`` tells where ``theirs`` comes from.

    Args:
        theirs: The record of the other scenario, see `Scenario.record`.
        mine: The record of the scenario here.
        where: Where ``theirs`` comes from, such as ``in the log``; it follows the value.
    """
    keys = ["scenario"] if theirs.get("scenario") != mine.get("scenario") else dict.fromkeys([*mine, *theirs])
    nothing = object()
    return [
        f"{key}: {theirs.get(key, 'nothing')!r} {where}, {mine.get(key, 'nothing')!r} here"
        for key in keys
        if theirs.get(key, nothing) != mine.get(key, nothing)
    ]


def is_dps(path: str) -> bool:
    """Return whether the system at ``path`` is the DPS or a part of it."""
    return path == "dps" or path.startswith("dps.")


def _is_no_board(path: str) -> bool:
    return path != BOARD


def _sampling_part(diagram: Diagram) -> SlowPart | None:
    sampling = {path: part for path, part in slow_parts(diagram).items() if part.samples_dps}
    if len(sampling) > 1:
        # A sample of each would contain the samples of the other that are under way, and so on.
        raise ValueError(
            f"a DPS has at most one slow part that samples its state, not {len(sampling)}: {', '.join(sampling)}"
        )
    return next(iter(sampling.values()), None)


def _geometry_watch(diagram: Diagram) -> GeometryWatch | None:
    """Return a watch over changed geometry; None if there is no SceneGraph, as in most DPS."""
    if not any(is_scene_graph(system) for _, system in leaves(diagram)):
        return None
    # Imported here: heavy, and already imported where there is a SceneGraph.
    from vtbdrake.state.geometry import GeometryWatch

    return GeometryWatch(diagram)


def _port_reader(port: OutputPort, context_of: Callable[[Context], Context]) -> Callable[[Context], Any]:
    if port.get_data_type() == PortDataType.kVectorValued:
        return lambda context: np.array(port.Eval(context_of(context)))
    return lambda context: port.EvalAbstract(context_of(context)).Clone().get_value()
