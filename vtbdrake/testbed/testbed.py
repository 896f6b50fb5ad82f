"""The virtual testbed (VTB) of Figure 4 as a Drake Diagram, with its switches, addresses and snapshots."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from math import ceil, inf
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import Context, Diagram, System

from vtbdrake import upper_layers
from vtbdrake.common.argument_checks import as_number
from vtbdrake.common.failures import FAILURES
from vtbdrake.drake_workarounds.cenic import CenicSimulator
from vtbdrake.state import Snapshot, SnapshotError, Variable, Variables
from vtbdrake.state import snapshot as snapshots
from vtbdrake.testbed.addressed import AddressedDiagram, WatchedSimulator, check_boundary
from vtbdrake.testbed.signal import SignalError
from vtbdrake.testbed.switch import ACT_POSITIONS, SENSE_POSITIONS, Position

if TYPE_CHECKING:
    from vtbdrake.testbed.builder import VirtualTestbedBuilder
    from vtbdrake.testbed.scenario import Scenario
    from vtbdrake.testbed.signal import Interface
    from vtbdrake.testbed.switch import Switches
    from vtbdrake.upper_layers import CompiledRollouts, View


@dataclass(frozen=True)
class BeliefRule:
    """A BeliefRule tells how estimates of the DPS set variables of the world; see `VirtualTestbedBuilder.believe`.

    ``targets`` (addresses in sim) are ``by`` of the estimates at the addresses ``of`` (in dps).

    ``age`` is the age of the estimates in seconds when the DPS gets the sensor values from which they are computed, for
    example because a sensor is sampled. Delays between machine and DPS do not count.

    ``period`` is the sample period of the estimates in seconds, 0 if they are computed at any time. If it is given,
    ``by`` gets the keyword ``late``, see `late`, to extrapolate the targets to the present.

    Attributes:
        targets: Addresses in sim that are set.
        of: Addresses of the estimates in dps.
        by: Returns the targets' values from the estimates; None: the estimate itself.
        age: The age of the estimates, in seconds.
        period: The sample period of the estimates, in seconds; 0 if they are computed at any time, None if ``by`` does
            not extrapolate.

    Raises:
        ValueError: There are several estimates and no ``by``; ``age`` or ``period`` is negative or infinite; or there
            is a ``period`` without ``by``.
    """

    targets: tuple[str, ...]
    of: tuple[str, ...]
    by: Callable[..., ArrayLike] | None = None
    age: float = 0.0
    period: float | None = None

    def __post_init__(self) -> None:
        if not self.targets:
            raise ValueError("a belief sets at least one variable of the simulated world, but no target is given")
        if not 0.0 <= as_number(f"the age of the belief about {self.target}", self.age) < inf:
            raise ValueError(f"the age of the belief about {self.target} is a time of at least 0 s, not {self.age!r}")
        if self.by is not None and not callable(self.by):
            raise ValueError(f"by= of the belief about {self.target} is a function of estimates, not {self.by!r}")
        if self.by is None and len(self.of) != 1:
            raise ValueError(
                f"the belief about {self.target} is of {len(self.of)} estimates: give the function of them as by="
            )
        period = 0.0 if self.period is None else as_number(f"the period of the belief about {self.target}", self.period)
        if not 0.0 <= period < inf:
            raise ValueError(
                f"the sample period of the belief about {self.target} is a time of at least 0 s, not {self.period!r}"
            )
        if self.period is not None and self.by is None:
            raise ValueError(
                f"the belief about {self.target} has a sample period, but no function that uses it: give the present "
                "value as by=f(estimates..., late=seconds)"
            )

    def check_addresses(self, variables: Variables) -> None:
        """Check the addresses of the belief.

        Raises:
            ValueError: An address does not exist, a target is not simulated, or an estimate is not part of the DPS.
        """
        for target in self.targets:
            variables[target]
            if not target.startswith("sim."):
                raise ValueError(f"a belief sets a variable of the simulated world, not {target}")
        for address in self.of:
            variables[address]
            if not address.startswith("dps."):
                raise ValueError(f"the belief about {self.target} is of {address}, which the DPS does not hold")

    @property
    def target(self) -> str:
        """Return the target as text; of several, the first one."""
        return f"{self.targets[0]}{', ...' if len(self.targets) > 1 else ''}"

    def late(self, time: float) -> float:
        """Return the age of the estimates at ``time``, in seconds: `age`, and the time since the DPS has sampled last.

        A sample that the DPS takes at ``time`` itself does not count yet.
        """
        if not self.period:
            return self.age
        # Drake's events come some nanoseconds early.
        last = self.period * (ceil(time / self.period - 1e-6) - 1)
        return self.age + time - last

    def values_of(self, estimates: Sequence[ArrayLike], *, late: float = 0.0) -> Sequence[ArrayLike] | np.ndarray:
        """Return the value of each target.

        Args:
            estimates: Values of the estimates, in the order of `of`.
            late: Age of the estimates in seconds; 0: the values at the instant that they describe.

        Raises:
            ValueError: There are not as many values as targets.
        """
        value: Any
        if self.by is None:
            value = estimates[0]
        else:
            value = self.by(*estimates) if self.period is None else self.by(*estimates, late=late)
        if len(self.targets) == 1:
            return [value]
        values = value if isinstance(value, np.ndarray) and value.ndim == 1 else list(value)
        if len(values) != len(self.targets):
            raise ValueError(f"the belief about {self.target} has {len(values)} values for {len(self.targets)} targets")
        return values


# Mode -> positions of (T_sense, T_act).
MODES = {
    "sim": (Position.SIM, Position.SIM),
    "shadow": (Position.REAL, Position.SIM),
    "real": (Position.REAL, Position.REAL),
    "twin": (Position.REAL, Position.TWIN),
}

Positions = str | Mapping[str, str] | None
"""Wanted positions of one side's switches: of all signals, or by signal; None changes nothing."""


def check_mode(mode: str) -> None:
    """Raise a ValueError if ``mode`` is not a mode of a testbed."""
    if mode not in MODES:
        raise ValueError(f"a testbed's mode is one of {', '.join(MODES)}, not {mode!r}")


def wanted_positions(
    interface: Interface, mode: str | None, sense: Positions, act: Positions
) -> tuple[dict[str, Position], dict[str, Position]]:
    """Return the wanted positions of the sensor and of the actuator signals, by signal.

    Args:
        interface: The interface of the DPS, which names the signals.
        mode: ``sim``, ``real``, ``shadow`` or ``twin``, for all switches; None: by ``sense`` and ``act``.
        sense: ``sim`` or ``real`` for all sensor signals, or by signal; None: no change.
        act: ``sim``, ``real`` or ``twin`` for all actuator signals, or by signal; None: no change.

    Raises:
        ValueError: The mode, a signal or a position is unknown, or there are a mode and positions.
    """
    if mode is not None:
        check_mode(mode)
        if sense is not None or act is not None:
            raise ValueError(f"give either the mode ({mode}) or the positions of a side, not both")
        sense, act = MODES[mode]
    sides: list[dict[str, Position]] = []
    for side, requested, signals, positions in (
        ("T_sense", sense, interface.sense, SENSE_POSITIONS),
        ("T_act", act, interface.act, ACT_POSITIONS),
    ):
        names = [signal.name for signal in signals]
        if not isinstance(requested, str | Mapping | None):
            raise ValueError(f"{side} takes one position for all signals, or {{signal: position}}, not {requested!r}")
        by_signal = dict.fromkeys(names, requested) if isinstance(requested, str) else dict(requested or {})
        for name, position in by_signal.items():
            if name not in names:
                raise ValueError(f"{side} has no signal {name!r}; it has: {', '.join(names)}")
            if position not in positions:
                raise ValueError(f"{side}.{name} goes to one of {', '.join(positions)}, not to {position!r}")
        sides.append({name: Position(position) for name, position in by_signal.items()})
    return sides[0], sides[1]


class _NamingSimulator(WatchedSimulator):
    """Drake's Simulator, which names the actuator command that a guard before the world, or a plant, has refused."""

    def __init__(self, testbed: VirtualTestbed, context: Context) -> None:
        super().__init__(testbed, context)
        self._testbed = testbed

    def AdvanceTo(self, boundary_time: float, interruptible: bool = True) -> SimulatorStatus:
        with _refused_command(self._testbed, self):
            return super().AdvanceTo(boundary_time, interruptible)


class _NamingCenicSimulator(CenicSimulator):
    """The same for CENIC: a class in Python has one base of Drake's."""

    def __init__(self, testbed: VirtualTestbed, context: Context) -> None:
        super().__init__(testbed.diagram, context)
        self._testbed = testbed

    def AdvanceTo(self, boundary_time: float, interruptible: bool = True) -> SimulatorStatus:
        check_boundary(self, boundary_time)
        with _refused_command(self._testbed, self):
            return super().AdvanceTo(boundary_time, interruptible)


@contextmanager
def _refused_command(testbed: VirtualTestbed, simulator: Simulator) -> Iterator[None]:
    """Raise a SignalError with the name of a command that is not finite, instead of what it has caused."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        named = testbed.named_command(simulator.get_context(), error)
        if named is error:
            raise
        raise named from error


class VirtualTestbed(AddressedDiagram):
    """A DPS in one Diagram with the simulated world around it, behind switches.

    Args:
        parts: The builder, with the parts.
        switches: The switches between them.
        commands: The variables of the constant commands.
        scenario: The scenario that built it, or None.

    Attributes:
        diagram: Input ports ``real.sense.<signal>``; output ports ``real.act.<signal>`` and ``real.act.active`` (1
            for every actuator signal that commands, else 0). While an actuator signal's switch is on sim, its real
            port carries no command: NaN, or an empty `ActuatorCommand` for an abstract signal. No system in it touches
            anything outside the Diagram, so that any of its contexts can be simulated without side effects.
        dps: The data processing system, a direct subsystem of the diagram.
        plant, scene_graph: Plant and SceneGraph of the simulated world, or None.
        simulated_sensors, simulated_actuators: The systems that offer sensor signals or take actuator signals, by
            signal.
        belief_rules: How estimates of the DPS set variables of the simulated world.
        visualized: True if the testbed draws into a Meshcat.
        guarded: True if vector commands that are not finite are refused before they enter the simulated world.
    """

    scenario: Scenario | None

    def __init__(
        self,
        parts: VirtualTestbedBuilder,
        dps: System,
        switches: Switches,
        diagram: Diagram,
        *,
        commands: Sequence[Variable],
        scenario: Scenario | None,
        visualized: bool,
        guarded: bool,
    ) -> None:
        """Make the testbed of the parts that `VirtualTestbedBuilder.build` has put together."""
        self._sense, self._act = switches.sense, switches.act
        selectors = [*self._sense.values(), *self._act.values()]
        super().__init__(
            diagram=diagram,
            interface=parts.interface,
            simulator_config=parts.simulator_config,
            scenario=scenario,
            extra=[*(selector.variable() for selector in selectors), *commands],
            by_demand=switches.idle_variables(),
            plant_roles=parts.plant_roles(),
        )
        self.dps = dps
        self.plant = parts.plant
        self.scene_graph = parts.scene_graph
        self.visualized = visualized
        self.guarded = guarded
        self._signals = {signal.name: signal for signal in parts.interface.sense}
        self.simulated_sensors = {name: port.get_system() for name, port in parts.sensors.items()}
        self.simulated_actuators = {name: port.get_system() for name, port in parts.actuators.items()}
        self.belief_rules = tuple(parts.belief_rules)
        for rule in self.belief_rules:
            rule.check_addresses(self._variables)

    def _repr_html_(self) -> str:
        """Show Figure 4 in a notebook, with the switches as they were built."""
        return upper_layers.svg(self)

    def _bare_simulator(self, context: Context) -> Simulator:
        if self.simulator_config.integration_scheme == "cenic":
            return _NamingCenicSimulator(self, context)
        return _NamingSimulator(self, context)

    def named_command(self, context: Context, error: Exception) -> Exception:
        """Return the reason why a simulation failed: a command of the DPS that is not finite, by name, or ``error``.

        Args:
            context: The root context where the simulation stands.
            error: What it raised.
        """
        dps_context = self.dps.GetMyContextFromRoot(context)
        for signal in self.interface.act:
            with suppress(*FAILURES):
                command = self.dps.GetOutputPort(signal.name).Eval(dps_context) if signal.is_vector else np.zeros(0)
                if not np.isfinite(command).all():
                    reason = "" if self.guarded else f"; {error}"
                    return SignalError(
                        f"the DPS commands {signal.name} = {command} at t = {context.get_time():g} s, which is not "
                        f"finite{reason}"
                    )
        return error

    # -- switches

    def positions(self, context: Context) -> dict[str, dict[str, str]]:
        """Return the positions of all switches: ``{"sense": {signal: position}, "act": {signal: position}}``."""
        self.check_context(context)
        sides = {"sense": self._sense, "act": self._act}
        return {side: {name: s.get(context).value for name, s in switches.items()} for side, switches in sides.items()}

    def switch(
        self,
        context: Context,
        mode: str | None = None,
        *,
        sense: Positions = None,
        act: Positions = None,
    ) -> None:
        """Throw switches, at any time.

        Args:
            context: A root context of this testbed.
            mode: Position of all switches: ``sim``, ``real``, ``shadow`` (sense real, act sim: the DPS reads the real
                sensors and commands no real actuator) or ``twin`` (both real, and the simulated actuators get the
                actuator commands too).
            sense: ``sim`` or ``real`` for all sensor signals, or by signal.
            act: ``sim``, ``real`` or ``twin`` for all actuator signals, or by signal.

        Raises:
            ValueError: A mode, position or signal is unknown, or a sensor signal that would become real has no value,
                or its value is NaN or does not fit. Then no switch has been thrown.
        """
        diagram_context = self._own_context(context)
        senses, acts = wanted_positions(self.interface, mode, sense, act)
        for name, position in senses.items():
            if position == Position.REAL:
                port = self.diagram.GetInputPort(f"real.sense.{name}")
                if not port.HasValue(diagram_context):
                    raise ValueError(
                        f"nothing feeds real.sense.{name}: fix a value on that input port, or start a bridge, before "
                        "its switch is thrown to real"
                    )
                self._signals[name].check_value(port.Eval(diagram_context))
        for selectors, positions in ((self._sense, senses), (self._act, acts)):
            for name, position in positions.items():
                selectors[name].set(context, position)

    def compiled(
        self,
        *,
        horizon: float,
        sample_period: float = 0.05,
        parameters: Sequence[str] = (),
        outputs: Sequence[str] = (),
        context: Context | None = None,
        compile: bool | None = None,
        check: bool = True,
        workers: int = 1,
    ) -> CompiledRollouts:
        """Turn the testbed, its DPS included, into one compiled function of a whole rollout.

        Args:
            horizon: The length of a rollout (s).
            sample_period: The period of the samples (s), which are taken before the updates of their instant.
            parameters: Addresses that will vary. State, commands and parameters of most systems can be varied without
                being named; masses and others of the plant, and errors of sensors that are 0, have to be.
            outputs: Addresses of variables or vector output ports to be recorded at the samples.
            context: Where rollouts begin, and what is compiled in; s0 if left out. All switches are at sim.
            compile: Whether to make machine code, which is kept for the next time; None does so if there is a C
                compiler, else CasADi interprets the function.
            check: Whether to compare rollouts with Drake's, step by step.
            workers: The number of threads for large batches.

        Raises:
            UnsupportedTestbedError: Parts of the testbed cannot be compiled; all are named, with a remedy.
            CompiledDifferenceError: A compiled rollout differs from Drake's.
            ValueError: An address does not exist, or cannot be varied.
            CompilerError: ``compile`` is True, and there is no C compiler, or it fails.
        """
        return upper_layers.CompiledRollouts(
            self.diagram,
            self.variables(),
            self.default_context() if context is None else context,
            horizon=horizon,
            sample_period=sample_period,
            parameters=parameters,
            outputs=outputs,
            timings=self.event_timings(),
            compile=compile,
            check=check,
            workers=workers,
        )

    def view(self, context: Context | None = None, **options: Any) -> View[Any]:
        """Run a copy of this testbed in the background, with a web page where it is watched and steered.

        Args:
            context: The state to start from; s0 if left out.
            options: Further keyword arguments of `vtbdrake.web.view`.

        Raises:
            ValueError: The testbed was built without a scenario, or as `vtbdrake.web.view` raises it.
        """
        if self.scenario is None:
            raise ValueError("this testbed was built without a scenario, so that no copy of it can be built")
        return upper_layers.view(self.scenario, start=None if context is None else self.snapshot(context), **options)

    # -- s(t) as a whole

    def restore(self, context: Context, snapshot: Snapshot) -> None:
        """Make ``context`` continue from ``snapshot``: s_sim(t0) from a file.

        Args:
            context: A root context of this testbed, which is changed.
            snapshot: A snapshot of a testbed of the same scenario.

        Raises:
            SnapshotError: The snapshot is of another scenario, or of a testbed that is built in another way.
        """
        self.check_context(context)
        self.check_scenario(snapshot)
        switches = [selector.name for selector in [*self._sense.values(), *self._act.values()]]
        if switches and not any(name in snapshot.values for name in switches):
            raise SnapshotError(
                "the snapshot is of a DPS alone, without a world: take one of a whole testbed, or restore this one "
                "by DpsAlone"
            )
        snapshots.apply(snapshot, self.diagram, context, self._variables)

    @property
    def believes(self) -> bool:
        """Return whether the testbed declares which estimates of its DPS set its simulated world."""
        return bool(self.belief_rules)

    def start_from_belief(self, context: Context) -> None:
        """Set the simulated world to what the DPS in ``context`` believes: s_sim(t0) from s_dps(t).

        Raises:
            ValueError: The testbed declares no belief, or a variable refuses its believed value.
        """
        self.write(context, self.belief(context))

    def belief(self, context: Context) -> dict[str, ArrayLike]:
        """Return the values of the simulated world's variables that the DPS in ``context`` believes, by address.

        An estimate beyond the bounds of its target (a joint a little past its stop) is clipped.

        Raises:
            ValueError: The testbed declares no belief, or there is none at present.
        """
        self.check_context(context)
        addresses = {address for rule in self.belief_rules for address in rule.of}
        estimates = {address: self._variables[address].get(context) for address in addresses}
        return self.belief_of(estimates, time=context.get_time())

    def belief_of(self, estimates: Mapping[str, Any], *, time: float) -> dict[str, ArrayLike]:
        """Return the values of the world's variables that a DPS with these estimates believes at ``time`` (s).

        Args:
            estimates: Values of the estimates of the DPS, by the addresses that `VirtualTestbedBuilder.believe` names.
            time: The time for which the world is believed, in seconds; estimates that are late are older.

        Raises:
            ValueError: The testbed declares no belief, or there is none at present.
        """
        if not self.belief_rules:
            raise ValueError(
                "this testbed does not declare which estimates of its DPS set its simulated world: see "
                "VirtualTestbedBuilder.believe"
            )
        values = {
            target: value
            for rule in self.belief_rules
            for target, value in zip(
                rule.targets, rule.values_of([estimates[a] for a in rule.of], late=rule.late(time)), strict=True
            )
        }
        return {address: np.clip(value, *self._variables[address].bounds) for address, value in values.items()}
