"""Belief: what a DPS knows when it reasons, and the starts of mental rollouts that follow from it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from math import inf
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, System
from pydrake.systems.primitives import DiscreteTimeDelay, ZeroOrderHold

from vtbdrake.common.argument_checks import as_array, as_whole
from vtbdrake.rollout.start import Start
from vtbdrake.state import Variable, VariableError
from vtbdrake.state.layout import FlatState, LayoutError
from vtbdrake.state.variables import A, html_table, with_unit
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.testbed.addressed import AddressedDiagram
from vtbdrake.testbed.dps_state import DpsState
from vtbdrake.testbed.switch import COMMAND
from vtbdrake.testbed.testbed import BeliefRule

if TYPE_CHECKING:
    from vtbdrake.optimization.risk import Risk

# Times that differ by less are equal, in s.
_ROUNDING = 1e-6

# An estimate may lie beyond the bounds of its variable by this share of their distance: a joint a little past its stop.
_BEYOND = 0.05


class BeliefError(ValueError):
    """A belief from which no rollout can begin."""


@dataclass(frozen=True, eq=False)
class World:
    """A true simulated world, for a perfect belief.

    Attributes:
        contents: Contents of the whole testbed.
        values: Address -> value of every variable of the simulated world that can be set.
    """

    contents: FlatState
    values: Mapping[str, ArrayLike]


@dataclass(frozen=True, eq=False, repr=False)
class Belief:
    """A Belief holds what a DPS believes at one instant: its own state, and the world according to its estimates.

    The mental scenario has the rules by which estimates set variables of the world (`VirtualTestbedBuilder.believe`),
    and determines everything that no rule sets. A belief is plain data, which can be pickled.

    Attributes:
        dps: The DPS: its state, parameters and commands, and the sensor values that it has received last.
        world: The true world if the belief is perfect, else None.

    Raises:
        ValueError: ``dps`` is no state of a DPS.
    """

    dps: DpsState
    world: World | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.dps, DpsState):
            raise ValueError(f"a belief is made of the state of a DPS, by Belief.of(...), not of {self.dps!r}")

    def __repr__(self) -> str:
        kind = "perfect belief" if self.world is not None else "belief"
        return f"<{kind} at t = {self.dps.time:g} s>"

    def _repr_html_(self) -> str:
        """Show in a notebook what the DPS has received and is told, and of the world what is believed."""
        rows: list[tuple[str, str, ArrayLike]] = [("received", name, v) for name, v in self.dps.received.items()]
        rows += [("command", name, value) for name, value in self.dps.commands.items()]
        rows += [("world", address, value) for address, value in (self.world.values if self.world else {}).items()]
        cells = [(kind, name, np.array2string(np.asarray(v), precision=5, threshold=6)) for kind, name, v in rows]
        table = html_table([("", "name", "value"), *cells])
        return f"<b>{escape(repr(self))}</b>{table}"

    @classmethod
    def of(cls, target: AddressedDiagram, context: Context) -> Belief:
        """Return the belief of the DPS in ``context``.

        Args:
            target: A testbed, or a DPS alone; for example the target of a Runtime.
            context: Context of the target; not changed.

        Raises:
            ValueError: The context belongs to another target.
        """
        target.check_context(context)
        return cls(target.dps_state(context))

    @classmethod
    def perfect(cls, testbed: VirtualTestbed, context: Context) -> Belief:
        """Return a belief that equals the true simulated world: for tests, and as a bound for any estimator.

        With the same scenario, a mental rollout is then the true future: bit for bit with a discrete plant or fixed
        steps; under error control up to about the integrator's accuracy, unless the running simulation is forked at
        this time and advanced to the sample times of the rollout, see `AddressedDiagram.fork`. With another mental
        scenario, all variables of the world that both scenarios have get their true values.

        Args:
            testbed: The running testbed.
            context: Its root context at the time of the belief.

        Raises:
            ValueError: The context belongs to another testbed.
        """
        if not isinstance(testbed, VirtualTestbed):
            raise ValueError(f"a perfect belief is one of a testbed, scenario.build(), not of {testbed!r}")
        testbed.check_context(context)
        settable = [v for a, v in testbed.variables().items() if a.startswith("sim.") and not v.derived]
        values = {variable.address: variable.get(context) for variable in settable}
        return cls(testbed.dps_state(context), World(testbed.whole_layout.take(context), values))

    def start(self, mental: VirtualTestbed) -> Start:
        """Return the start of a rollout of ``mental`` in the believed world; see `BeliefToStart.start`."""
        return BeliefToStart(mental).start(self)


# How an estimate is uncertain: a standard deviation (scalar or of the variable's shape), a covariance matrix, or a
# function that draws: (believed value, random generator) -> value.
Uncertainty = ArrayLike | Callable[[Any, np.random.Generator], ArrayLike]
# By address; or samples of variables that vary together, such as `Scenario.samples`.
Uncertainties = Mapping[str, Uncertainty] | Sequence[Mapping[str, ArrayLike]]


@dataclass(frozen=True, kw_only=True)
class BeliefConfig:
    """How a reasoner uses its belief: from how many samples, and how old it may be.

    Attributes:
        samples: Number of samples of an uncertain belief from which each candidate is simulated, at least 2; 1 if the
            belief is certain.
        uncertainty: Uncertainty of the belief, by address of a variable of the simulated world, or samples; see
            `BeliefToStart`.
        max_age: The largest age of a belief, in seconds.
        risk: How the qualities under several samples become one: ``worst``, ``mean``, `Quantile` or `CVaR`.

    Raises:
        ValueError: There is no sample; there are several samples of a certain belief, or one of an uncertain one.
    """

    samples: int = 1
    uncertainty: Uncertainties | None = None
    max_age: float = inf
    risk: str | Risk = "worst"

    def __post_init__(self) -> None:
        object.__setattr__(self, "samples", as_whole("the number of samples", self.samples))
        if self.samples < 1:
            raise ValueError(f"a belief has at least one sample, not {self.samples}")
        if (self.samples > 1) != bool(self.uncertainty):
            raise ValueError(
                f"samples={self.samples} with uncertainty={self.uncertainty!r}: of an uncertain belief several samples "
                "are drawn (one is a world by chance), of a certain one all are the same; give both, samples=8 say, or "
                "neither"
            )


class BeliefToStart:
    """Turns beliefs into starts for the rollouts of one mental testbed.

    1. The DPS continues in its present state, at its own time, with its present commands u.
    2. The world is the mental scenario's, except for the variables that the DPS's estimates set by the
       scenario's rules (`VirtualTestbedBuilder.believe`). An estimate that lies beyond the bounds of its variable by at
       most 5 % of their distance is clipped. Velocities without a rule are zero.
    3. Sensors keep the values that the DPS has received last, also for samples in transit, until they sample in the
       mental world. (A measurement of the believed state would differ from these values by the errors of the estimates,
       and the filters of the DPS would see a jump.) Actuators begin as if they had received the present command of the
       DPS for some time. Sensors and actuators without a method ``resume``, such as cameras, begin as in the mental
       scenario.

    A rule with a ``period`` extrapolates its estimates to the present. Variables set by other rules are late, by the
    age of the estimates and by up to a sample period.

    Attributes:
        uncertain: The addresses of the variables that are drawn.

    Args:
        mental: The testbed of the rollouts.
        uncertainty: Uncertainty of the belief, by address of a variable of the simulated world: a standard deviation, a
            covariance matrix, or a function (believed value, random generator) -> value. For a variable without a
            rule, the believed value is the mental scenario's. Or samples (address -> value) of variables that
            vary together, as `Scenario.samples` draws them: world n takes sample n, and begins again after the last.
        seed: With the number of a sample, determines its random numbers, in the same way for every belief.
        max_age: The largest age of a belief in seconds.

    Raises:
        BeliefError: An uncertainty names no variable of the simulated world, or does not fit its shape.
    """

    def __init__(
        self,
        mental: VirtualTestbed,
        *,
        uncertainty: Uncertainties | None = None,
        seed: int = 0,
        max_age: float = inf,
    ) -> None:
        if not max_age > 0.0:
            raise ValueError(f"the largest age of a belief is a positive time, not {max_age} s")
        is_samples = isinstance(uncertainty, Sequence) and all(isinstance(each, Mapping) for each in uncertainty)
        if not isinstance(uncertainty, Mapping | None) and not is_samples:
            raise BeliefError(
                f"uncertainty is given by address, {{address: standard deviation}}, or as samples {{address: value}}, "
                f"not as {uncertainty!r}"
            )
        self._mental = mental
        self._max_age = max_age
        self._seed = seed
        self._variables = mental.variables()
        self._context = mental.default_context()
        self._default = mental.start_layout.take(self._context)
        self._dps = mental.dps_layout.indices_in(mental.start_layout)
        self._samples = [self._whole(sample) for sample in uncertainty] if isinstance(uncertainty, Sequence) else []
        spreads = uncertainty if isinstance(uncertainty, Mapping) else {}
        uncertain = {*spreads, *(address for sample in self._samples for address in sample)}
        self.uncertain = tuple(sorted(uncertain))
        vectors = {signal.name for signal in [*mental.interface.sense, *mental.interface.act] if signal.is_vector}
        self._sensors = {n: s for n, s in mental.simulated_sensors.items() if n in vectors and can_resume(s)}
        self._actuators = {n: s for n, s in mental.simulated_actuators.items() if n in vectors and can_resume(s)}
        self._rules = [_Rule(mental, rule, drawn=uncertain) for rule in mental.belief_rules]
        self._estimates = {
            address: (variable, mental.dps_layout.slice_of(variable))
            for rule in mental.belief_rules
            for address in rule.of
            for variable in [self._variables[address]]
        }
        self._draws = {address: self._draw(address, how) for address, how in spreads.items()}
        # The believed values of uncertain variables without a rule.
        self._prior = {a: np.asarray(self._variables[a].get(self._context)) for a in uncertain}
        set_by = [*self._prior, *(target.address for rule in self._rules for target in rule.targets)]
        self._kinds = {a: (v.kind, mental.start_layout.slice_of(v)) for a in set_by for v in [self._variables[a]]}

    def _whole(self, sample: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
        """Return a sample by the addresses of whole variables, in place of their entries."""
        context = self._mental.default_context()
        try:
            self._variables.write(context, sample)
            addresses = dict.fromkeys(address.partition("[")[0] for address in sample)
            return {address: np.asarray(self._variables[address].get(context)) for address in addresses}
        except ValueError as error:
            raise BeliefError(f"a sample of the belief does not fit the mental world: {error}") from error

    def _draw(self, address: str, how: Uncertainty) -> Callable[[np.ndarray, np.random.Generator], ArrayLike]:
        variable = self._variables[address]
        if not address.startswith("sim.") or variable.derived:
            raise BeliefError(f"uncertainty is of variables of the simulated world that can be set, unlike {address}")
        if callable(how):
            return how
        spread, size = np.asarray(how, dtype=float), int(np.prod(variable.shape, dtype=int))
        if spread.shape == (size, size) and size > 1 and np.isfinite(spread).all():
            values, axes = np.linalg.eigh(spread)
            if not (
                np.isfinite(spread).all() and np.allclose(spread, spread.T) and values[0] >= -1e-9 * abs(values[-1])
            ):
                raise BeliefError(
                    f"the covariance of {address} must be symmetric and positive semidefinite, not {how!r}"
                )
            root = axes * np.sqrt(np.maximum(values, 0.0))
            return lambda mean, rng: mean + (root @ rng.standard_normal(size)).reshape(variable.shape)
        if spread.shape not in ((), variable.shape) or not (np.isfinite(spread) & (spread >= 0.0)).all():
            raise BeliefError(
                f"the uncertainty of {address}, of shape {variable.shape}, is a standard deviation, one per entry, a "
                f"covariance matrix or a function, not {how!r}"
            )
        return lambda mean, rng: mean + spread * rng.standard_normal(variable.shape)

    def start(self, belief: Belief, *, now: float = -inf) -> Start:
        """Return the start of a rollout in the believed world.

        Args:
            belief: The belief of the DPS.
            now: The present time of the DPS in seconds, from which the age of the belief follows.

        Raises:
            BeliefError: The belief is too old; its DPS does not fit the DPS of the mental testbed; an estimate is
                missing (not finite) or lies outside the bounds of its variable; or the mental scenario has no rules.
        """
        self._check_belief(belief, now)
        if belief.world is not None:
            return self._perfect(belief.dps, belief.world)
        return self._start(belief.dps, *self._believed(belief.dps))

    def starts(self, belief: Belief, *, samples: int, now: float = -inf) -> list[Start]:
        """Return starts in ``samples`` worlds, drawn from the belief and its uncertainty; see `start`.

        World n is drawn with the seed and n, so that the same belief gives the same starts. A value beyond the bounds
        of its variable is clipped. Without uncertainty, all worlds are the believed one; with a perfect belief, they
        are drawn around the true one.

        Args:
            belief: The belief.
            samples: Number of worlds.
            now: Present time in s, which the belief's age is judged by.

        Raises:
            BeliefError: As in `start`.
        """
        if not (self._draws or self._samples):
            return [self.start(belief, now=now)] * samples
        self._check_belief(belief, now)
        if belief.world is not None:
            start, truth = self._perfect(belief.dps, belief.world), {**self._prior, **belief.world.values}
            return [replace(start, values={**start.values, **self._sample(n, truth)}) for n in range(samples)]
        numbers, believed = self._believed(belief.dps)
        return [self._start(belief.dps, numbers, believed | self._sample(n, believed)) for n in range(samples)]

    def _sample(self, n: int, believed: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
        """Return the uncertain values of world n by address."""
        rng = np.random.default_rng([self._seed, n])
        drawn = {a: self._drawn(a, draw(np.asarray(believed[a]), rng)) for a, draw in self._draws.items()}
        return drawn | (self._samples[n % len(self._samples)] if self._samples else {})

    def _drawn(self, address: str, value: ArrayLike) -> np.ndarray:
        variable = self._variables[address]
        drawn = as_array(f"what was drawn for {address}", value)
        if drawn.shape != variable.shape or not np.isfinite(drawn).all():
            raise BeliefError(
                f"{address} takes finite numbers of shape {variable.shape}, but {value!r} was drawn for it"
            )
        return np.clip(drawn, *variable.bounds)

    def _check_belief(self, belief: Belief, now: float) -> None:
        if not isinstance(belief, Belief):
            raise BeliefError(f"a rollout begins from a Belief, from Belief.of(testbed, context), say, not {belief!r}")
        age = now - belief.dps.time
        if age == -inf and self._max_age < inf:
            raise BeliefError(
                f"whether the belief is older than max_age = {self._max_age:g} s depends on now: give now="
            )
        if -inf < age < -_ROUNDING:
            raise BeliefError(f"the belief is of t = {belief.dps.time:g} s, which lies after now = {now:g} s")
        if not age <= self._max_age:
            raise BeliefError(
                f"the belief is of t = {belief.dps.time:g} s and {age:g} s old, but at most {self._max_age:g} s are "
                "allowed (max_age)"
            )

    def _believed(self, dps: DpsState) -> tuple[np.ndarray, dict[str, ArrayLike]]:
        """Return the numbers of the start layout, with the DPS and all that is written into them at once (see `_Rule`).

        And the other believed values, by address.
        """
        if not self._mental.belief_rules:
            raise BeliefError(
                f"{self._mental.scenario!r} does not declare which estimates of its DPS set its simulated world: "
                "declare them with VirtualTestbedBuilder.believe, or begin in the true world of a simulated testbed, "
                "Belief.perfect(testbed, context)"
            )
        self._check_dps(dps)
        for name in self._sensors:
            if name not in dps.received:
                raise BeliefError(f"the DPS has not received {name} yet, so that it does not know its world")
        if None in [place for _, place in self._estimates.values()]:
            self._mental.dps_layout.put(self._context, dps.contents)
        of_dps, estimates = dps.contents.numbers, {}
        for address, (variable, place) in self._estimates.items():
            if place is None:
                estimates[address] = variable.get(self._context)
            elif variable.shape:
                estimates[address] = of_dps[place].reshape(variable.shape)
            else:
                estimates[address] = of_dps.item(place.start)
        numbers, believed = self._default.numbers.copy(), dict[str, ArrayLike](self._prior)
        numbers[self._dps] = of_dps
        for rule in self._rules:
            values = rule.values(estimates, dps.time)
            if rule.places is None:
                believed |= zip(rule.addresses, values, strict=True)
            else:
                numbers[rule.places] = values
        return numbers, believed

    def _check_dps(self, dps: DpsState) -> None:
        try:
            self._mental.dps_layout.check(dps.contents)
        except LayoutError as error:
            raise BeliefError(
                f"the DPS that believes does not fit the DPS of the mental scenario {self._mental.scenario!r}: {error}"
            ) from error

    def _commands(self, dps: DpsState) -> dict[str, ArrayLike]:
        # A command may come from a port of the world instead.
        commands = {f"{COMMAND}{name}": value for name, value in dps.commands.items()}
        return {address: value for address, value in commands.items() if address in self._variables}

    def _start(self, dps: DpsState, believed_numbers: np.ndarray, believed: Mapping[str, ArrayLike]) -> Start:
        """Return the start of a rollout with the believed values (see `_believed`), in which the DPS continues."""
        context, layout, commands = self._context, self._mental.start_layout, self._commands(dps)
        numbers, rest, later = believed_numbers.copy(), {}, {}
        for address, value in believed.items():
            kind, place = self._kinds[address]
            if place is not None:
                numbers[place] = np.ravel(value) if place.stop - place.start > 1 else value
            elif kind == A:
                later[address] = value
            else:
                rest[address] = value
        context.SetTime(dps.time)
        abstract = {**self._default.abstract, **dps.contents.abstract}
        layout.put(context, FlatState(layout.names, numbers, abstract))
        try:
            # The commands matter here to actuators alone.
            self._variables.write(context, rest | commands if self._actuators else rest)
        except VariableError as error:
            raise BeliefError(f"the believed values cannot be set in the mental world: {error}") from error
        for name, sensor in self._sensors.items():
            _resume(sensor, context, dps.received[name])
        dps_context = self._mental.dps.GetMyContextFromRoot(context)
        for name, actuator in self._actuators.items():
            _resume(actuator, context, self._mental.dps.GetOutputPort(name).Eval(dps_context))
        return Start(dps.time, layout.take(context), {**commands, **later})

    def _perfect(self, dps: DpsState, world: World) -> Start:
        hidden = {a: value for a, value in world.values.items() if a in self._variables and self._variables[a].hidden}
        values = {**self._commands(dps), **hidden}
        if world.contents.names == self._mental.whole_layout.names:
            return Start(dps.time, world.contents, values)
        self._check_dps(dps)
        context = self._mental.default_context()
        context.SetTime(dps.time)
        self._mental.dps_layout.put(context, dps.contents)
        variables = [v for v in self._variables.values() if not v.derived and v.address in world.values]
        try:
            # In the order in which `Variables.write` sets them. What is equal stays, as setting an inertia rounds it.
            for variable in sorted(variables, key=lambda variable: variable.order):
                value = world.values[variable.address]
                if variable.shape == np.shape(value) and not np.array_equal(variable.get(context), value):
                    variable.set(context, value)
        except VariableError as error:
            raise BeliefError(f"the true values cannot be set in the mental world: {error}") from error
        return Start(dps.time, self._mental.whole_layout.take(context), values)


class _Rule:
    """A rule of a mental testbed.

    Args:
        mental: The testbed of the rollouts.
        rule: The rule.
        drawn: Addresses of the variables that are drawn.

    Attributes:
        targets: What it sets.
        addresses: The addresses of the targets.
        places: Where the targets lie in the numbers of the start layout, if all are single numbers there, such as joint
            angles, and none is drawn: they are checked and written at once.
    """

    def __init__(self, mental: VirtualTestbed, rule: BeliefRule, *, drawn: Collection[str]) -> None:
        self._rule = rule
        self.addresses = rule.targets
        self.targets = [_Target(mental.variables()[address]) for address in rule.targets]
        places = [mental.start_layout.slice_of(target.variable) for target in self.targets]
        single = [place.start for place in places if place is not None and place.stop - place.start == 1]
        is_whole = len(single) == len(places) and not set(rule.targets) & set(drawn)
        self.places = np.array(single) if is_whole else None
        self._ends = np.array([target.ends for target in self.targets]).T if is_whole else np.empty((2, 0))

    def values(self, estimates: Mapping[str, Any], time: float) -> Sequence[ArrayLike] | np.ndarray:
        """Return the believed values of the targets, within the bounds of their variables.

        Args:
            estimates: Address -> value of estimates.
            time: Time of the DPS in seconds.

        Raises:
            BeliefError: A value is missing, or lies beyond the bounds.
        """
        basis = {address: estimates[address] for address in self._rule.of}
        values = self._rule.values_of([*basis.values()], late=self._rule.late(time))
        if isinstance(values, np.ndarray) and self.places is not None and values.dtype == float:
            least, most = self._ends
            if ((values >= least) & (values <= most)).all():
                return values
        return [target.checked(value, basis) for target, value in zip(self.targets, values, strict=True)]


class _Target:
    """A variable of the simulated world that a rule sets.

    Attributes:
        address: Its address.
        variable: The variable.
        ends: The ends of its bounds; an infinite value is within no bounds.
    """

    def __init__(self, variable: Variable) -> None:
        self.variable, self.address = variable, variable.address
        lower, upper = (np.asarray(bound, dtype=float) for bound in variable.bounds)
        distance = upper - lower
        self._tolerance = np.where(np.isfinite(distance), _BEYOND * distance, 0.0)
        largest = np.finfo(float).max
        self.ends = np.maximum(lower, -largest), np.minimum(upper, largest)

    def checked(self, value: Any, basis: Mapping[str, Any]) -> ArrayLike:
        """Return the believed value, within the bounds of the variable.

        Args:
            value: The value by the rule.
            basis: Address -> value of the estimates of the rule, for messages.

        Raises:
            BeliefError: The value is missing, or lies beyond the bounds.
        """
        variable, (least, most) = self.variable, self.ends
        try:
            believed = as_array(variable.address, value).reshape(variable.shape)
        except ValueError as error:
            raise BeliefError(
                f"{variable.address} takes numbers of shape {variable.shape}, but {value!r} is believed, "
                f"of {_plain(basis)}"
            ) from error
        if ((believed >= least) & (believed <= most)).all():
            return believed
        if not np.isfinite(believed).all():
            raise BeliefError(
                f"the belief about {variable.address} is missing: {believed.tolist()}, of {_plain(basis)}"
            )
        if ((believed < least - self._tolerance) | (believed > most + self._tolerance)).any():
            amount, allowed = with_unit(str(believed.tolist()), variable.unit), variable.bounds_text()
            raise BeliefError(
                f"the belief about {variable.address} is {amount}, of {_plain(basis)}, but it must lie in {allowed}"
            )
        return np.clip(believed, least, most)


def _plain(estimates: Mapping[str, Any]) -> dict[str, Any]:
    return {address: np.asarray(estimate).tolist() for address, estimate in estimates.items()}


def _resume(system: System, root: Context, value: Any) -> None:
    """Set a sensor or an actuator to the state of one whose last output or input, respectively, was ``value``."""
    context = system.GetMyMutableContextFromRoot(root)
    if is_hold(system):
        context.SetDiscreteState(0, np.resize(value, context.get_discrete_state(0).size()))
    else:
        system.resume(context, value)


def can_resume(system: System) -> bool:
    """Return whether a mental copy can continue a sensor or an actuator."""
    return hasattr(system, "resume") or is_hold(system)


def is_hold(system: System) -> bool:
    """Return whether a system is one of Drake's that sample their input, and show it later or until the next sample."""
    return isinstance(system, ZeroOrderHold | DiscreteTimeDelay)
