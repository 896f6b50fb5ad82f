"""The reasoner on board: a slow part of the DPS that decides by rollouts in a mental copy of its own testbed."""

from __future__ import annotations

import logging
import os
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, State

from vtbdrake.reasoning.belief import Belief, BeliefError
from vtbdrake.reasoning.decision import Budget
from vtbdrake.reasoning.reasoner import Reasoner, SearchConfig
from vtbdrake.state import Quantity
from vtbdrake.testbed import Scenario, SlowPart, slow_parts
from vtbdrake.testbed.dps_state import DpsState
from vtbdrake.testbed.slow_function import SlowFunction

if TYPE_CHECKING:
    from vtbdrake.compiled.equations import Equations
    from vtbdrake.reasoning.decision import Decision
    from vtbdrake.reasoning.space import Element
    from vtbdrake.rollout import Quality

_log = logging.getLogger(__name__)

# The share of the latency that a decision beside a loop may take; the rest is for communication.
_SHARE = 0.8

# The niceness of the processes beside a loop, so that they leave the processors to others.
_NICENESS = 5

_DECISION = "decision"
_CANDIDATE = "candidate"
_CANDIDATE_AT = "candidate_at"
_QUALITY = "quality"
_IMPROVEMENT = "improvement"
_ROLLOUTS = "rollouts"


class OnboardReasoner(SlowPart):
    """A part of the DPS that decides by rollouts of the DPS's own testbed, while the fast loop runs.

    .. pydrake_system::

        name: OnboardReasoner
        input_ports:
        - <believed>
        - request (only with ``on_request``)
        - dps (filled by `AddressedDiagram.attach`)
        output_ports:
        - decision
        - quality (of the decision, in the unit of the quality; at first NaN)
        - improvement (over the plan in use, likewise; NaN if that is not eligible)
        - rollouts (that the decision took)
        - sampled_at (s; when the state was sampled from which the decision was made, at first -inf)
        - valid (1 if the decision that was due last was made in time, else 0)
        - missed (the number of decisions that were not)
        - taken (only with ``on_request``: the request that was taken last, at first 0)

    At t_k the part samples the state of the DPS. From t_k + latency on, ``decision`` is the best candidate that a
    `Reasoner` has found. If none is eligible, or no rollout can begin from the belief, or the answer is late, the plan
    in use stays and ``valid`` is 0; the DPS must react to that itself.

    In a mental copy (``mental=True``) the same part, with the same ports, does not reason. At t_k + latency it shows
    the candidate of the rollout, its parameter ``candidate``. So each candidate enters the DPS at the port and at the
    instant at which the decision will enter it. Afterwards the plan stays, and no request is taken. The outputs
    ``quality``, ``improvement``, ``rollouts`` and ``missed`` do not change in a mental copy: if the behaviour of the
    DPS depends on them, mental rollouts predict it wrongly.

    In a simulation a decision takes exactly the latency, and the budget counts rollouts, so that the decision can be
    repeated exactly; the rollouts run one after another in the thread of the simulation: in Drake, or in the compiled
    testbed if the executor is ``compiled``. Beside a loop they run in processes of their own, and the decision is the
    best candidate found within 0.8 (latency - period of the loop).

    Args:
        size: Number of entries of the decision.
        scenario: Scenario of the DPS. Its `Scenario.mental` has this part in the same place, with ``mental=True``.
        decision: The decided elements, see `Reasoner`: the parameter ``candidate`` of this part
            (``dps.<path>.candidate``), or entries of it (``dps.<path>.candidate[0]``).
        quality: See `Reasoner`.
        horizon: Length of a rollout from t_k on, in seconds; longer than the latency.
        budget: Budget of a decision, which counts rollouts. Its seconds, if given, are the time limit beside a loop:
            for a machine in lock-step, which waits, it may be longer than the latency.
        period, latency, offset, patience: See `SlowPart`. As a decision takes no longer than its latency, the patience
            is short.
        initial: The decision until the first one is made, a scalar or shape (size,).
        on_request: Whether to decide once for each new request. Otherwise the part decides at every t_k, at a receding
            horizon, and the latency is at most the period.
        believed: Names of further input ports, with their sizes. In a mental copy, the parameter of that name of this
            part is the value of the port at t_k, for the rules that lead from estimates to the simulated world
            (`VirtualTestbedBuilder.believe`).
        mental: Whether this is the part of a mental copy.
        options: Further arguments of `Reasoner`. An executor of its `SearchConfig` other than ``compiled`` applies
            beside a loop only.

    Raises:
        ValueError: The budget does not count rollouts, another element than ``candidate`` is decided, the horizon ends
            before a decision is shown, or see `SlowPart`.
    """

    def __init__(
        self,
        size: int,
        *,
        scenario: Scenario,
        decision: Sequence[Element],
        quality: Quality,
        horizon: float,
        budget: Budget,
        period: float,
        latency: float,
        offset: float = 0.0,
        patience: float = 3.0,
        initial: ArrayLike = 0.0,
        on_request: bool = False,
        believed: Mapping[str, int] | None = None,
        mental: bool = False,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        _check_arguments(decision, budget, horizon, latency)
        arguments = {
            "scenario": scenario,
            "decision": tuple(decision),
            "quality": quality,
            "horizon": horizon,
            "budget": budget,
            "search": SearchConfig(),
            **(options or {}),
        }
        believed = dict(believed or {})
        self._decider = _Decider(arguments)
        super().__init__(
            self._decider,
            inputs=believed,
            outputs={_DECISION: size, **dict.fromkeys((_QUALITY, _IMPROVEMENT, _ROLLOUTS), 1)},
            period=period,
            latency=latency,
            offset=offset,
            patience=patience,
            initial={
                _DECISION: np.array(np.broadcast_to(np.asarray(initial, dtype=float), (size,))),
                _QUALITY: np.array([np.nan]),
                _IMPROVEMENT: np.array([np.nan]),
            },
            on_request=on_request,
            samples_dps=True,
        )
        self.mental = mental
        parameters = {
            name: Quantity(np.zeros(n) if n > 1 else 0.0) for name, n in {_CANDIDATE: size, **believed}.items()
        }
        parameters[_CANDIDATE_AT] = Quantity(-inf, "s")
        groups = {name: self.declare_parameters(**{name: quantity}) for name, quantity in parameters.items()}
        self._candidate, self._candidate_at = groups[_CANDIDATE], groups[_CANDIDATE_AT]

    def remember(self, count: int) -> None:
        """Keep the last ``count`` decisions that this part makes in simulations, for `decision_shown`."""
        self._decider.remember(count)

    def decision_shown(
        self, context: Context, also: tuple[Reasoner, Decision] | None = None
    ) -> tuple[Reasoner, Decision] | None:
        """Return the decision that the ports of ``context`` show, with its reasoner.

        It is None if it is neither remembered nor ``also``: simulations of other contexts make decisions, too.

        Args:
            context: The part's own context.
            also: A reasoner and a decision that may be the one shown, though it is not remembered.
        """
        sampled_at, quality = (self.GetOutputPort(name).Eval(context).item() for name in ("sampled_at", _QUALITY))
        candidates = [*self._decider.remembered, *([] if also is None else [also])]
        matches = [each for each in candidates if (each[1].time, each[1].quality) == (sampled_at, quality)]
        return matches[-1] if matches else None

    def function_beside(self, period: float) -> SlowFunction:
        return replace(self.function, function=self._decider.limited(_SHARE * (self.latency - period)))

    def compiled_equations(self, context: Context, varied: frozenset[str]) -> Equations:
        """Return the equations of the part of a mental copy; see `VirtualTestbed.compiled`.

        A class derived from this one has the same equations if it defines a constructor alone; else it writes its own.

        Args:
            context: The context of this part, whose values are compiled in.
            varied: The variables of this part that stay arguments of the compiled functions.
        """
        # Imported here: without it, a reasoner needs no CasADi.
        from vtbdrake.compiled.components import CandidateEquations
        from vtbdrake.compiled.equations import refusal

        kinds = type(self).__mro__
        defined = {name for kind in kinds[: kinds.index(OnboardReasoner)] for name in vars(kind)}
        if changed := sorted(name for name in defined if not name.startswith("__")):
            raise refusal(
                self,
                f"is derived from OnboardReasoner, and does something else, as it defines {', '.join(changed)}: define "
                "a constructor alone, or the method compiled_equations",
            )
        return CandidateEquations(self, context, varied)

    @property
    def on_request(self) -> bool:
        """Return whether the part decides on request only."""
        return self._request is not None

    @property
    def candidate_groups(self) -> tuple[int, int]:
        """Return the numbers of the parameter groups with the candidate, and with the time of its decision."""
        return int(self._candidate.index), int(self._candidate_at.index)

    def _sample(self, context: Context, state: State) -> None:
        if not self.mental:
            super()._sample(context, state)
        elif self._request is not None and self._is_for_candidate(self._tick(context, 0.0), context):
            self._take_request(context, state)

    def _show(self, context: Context, state: State) -> None:
        if not self.mental:
            super()._show(context, state)
            return
        tick = self._tick(context, self.latency)
        if self._is_for_candidate(tick, context):
            self._show_vectors(state, tick, {_DECISION: self._candidate.array(context)})

    def _is_for_candidate(self, tick: int, context: Context) -> bool:
        """Return whether the candidate of the rollout is the result of sample number ``tick``."""
        at = self._candidate_at.view(context).candidate_at
        return bool(abs(at - self.offset - tick * self.period) < 0.5 * self.period)


class _Decider:
    """The function of an `OnboardReasoner`. It makes its reasoner at the first call, and keeps it.

    A decision depends on nothing but the arguments of the call. Several contexts of one Diagram take turns.

    Args:
        arguments: Arguments of the reasoner.
        seconds: The longest wall time of a decision beside a loop, if the budget has none.
    """

    def __init__(self, arguments: Mapping[str, Any], seconds: float | None = None) -> None:
        self._arguments = dict(arguments)
        self._seconds = seconds
        self._budget: Budget = replace(self._arguments["budget"], seconds=None)
        self._reasoner: _CandidateReasoner | None = None
        self._last_reason = ""
        self.remembered: deque[tuple[Reasoner, Decision]] = deque(maxlen=0)
        self._taking_turns = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        return _Decider, (self._arguments, self._seconds)

    def limited(self, seconds: float) -> _Decider:
        """Return a copy whose decisions beside a loop take at most ``seconds``."""
        return _Decider(self._arguments, seconds)

    def remember(self, count: int) -> None:
        """Keep the last ``count`` decisions."""
        self.remembered = deque(self.remembered, maxlen=count)

    def prepare(self) -> None:
        """Make the reasoner of a process beside a loop, and let its workers build their testbeds."""
        os.nice(_NICENESS)
        budget = self._arguments["budget"]
        self._budget = replace(budget, seconds=budget.seconds or self._seconds)
        self._reasoner = _CandidateReasoner(self._arguments)
        self._reasoner.reasoner.warm_up()

    def __call__(
        self, *, dps: DpsState, request: np.ndarray | None = None, **believed: np.ndarray
    ) -> dict[str, np.ndarray] | None:
        """Return the outputs of the part, or None if there is no decision.

        Args:
            dps: The state of the DPS.
            request: The request; its value does not matter.
            **believed: The values of the further ports.
        """
        with self._taking_turns:
            if self._reasoner is None:
                self._reasoner = _CandidateReasoner(
                    {**self._arguments, "search": _in_this_thread(self._arguments["search"])}
                )
            try:
                decision = self._reasoner.decide(dps, believed, budget=self._budget)
                reason = "" if decision else decision.message
            except BeliefError as error:
                reason = str(error)
            if reason and reason != self._last_reason:  # Not with every sample.
                _log.warning("nothing was decided at t = %g s: %s", dps.time, reason)
            self._last_reason = reason
            if reason:
                return None
            self.remembered.append((self._reasoner.reasoner, decision))
            return {
                _DECISION: self._reasoner.candidate_of(decision),
                _QUALITY: np.array([decision.quality]),
                _IMPROVEMENT: np.array([decision.health.improvement]),
                _ROLLOUTS: np.array([float(decision.health.rollouts)]),
            }


class _CandidateReasoner:
    """A reasoner with the variables of its `OnboardReasoner`, and a candidate in a context of its testbed.

    Args:
        arguments: Arguments of the reasoner.

    Attributes:
        reasoner: The reasoner.

    Raises:
        ValueError: The mental scenario reasons itself, or something else than the candidate is decided.
    """

    def __init__(self, arguments: Mapping[str, Any]) -> None:
        self.reasoner = Reasoner(**arguments)
        self._testbed = testbed = self.reasoner.problem.testbed
        self._context = testbed.default_context()
        parts = {path: part for path, part in slow_parts(testbed.diagram).items() if isinstance(part, OnboardReasoner)}
        if [part.mental for part in parts.values()] != [True]:
            raise ValueError(
                f"the mental scenario {type(testbed.scenario).__name__} reasons itself: give its OnboardReasoner "
                "mental=True, by a field that Scenario.mental() sets"
            )
        ((path, part),) = parts.items()
        self._variables = {element.name: testbed.variables()[f"{path}.{element.name}"] for element in part.variables}
        self._places = {name: testbed.dps_layout.slice_of(variable) for name, variable in self._variables.items()}
        for element in arguments["decision"]:
            if element.address.partition("[")[0] != self._variables[_CANDIDATE].address:
                raise ValueError(f"a reasoner on board decides {path}.{_CANDIDATE}, not {element.address}")

    def decide(self, dps: DpsState, believed: Mapping[str, np.ndarray], *, budget: Budget) -> Decision:
        """Return the decision of the reasoner for a DPS.

        Args:
            dps: The state of the DPS.
            believed: The values of the ports of the part, by name.
            budget: How much the decision may take.

        Raises:
            BeliefError: See `Reasoner.decide`.
        """
        return self.reasoner.decide(self._belief(dps, believed), budget=budget, now=dps.time)

    def candidate_of(self, decision: Decision) -> np.ndarray:
        """Return the candidate of the last belief with the entries that the decision sets, which may be only some."""
        decision.apply(self._testbed, self._context)
        return np.atleast_1d(self._variables[_CANDIDATE].get(self._context))

    def _belief(self, dps: DpsState, believed: Mapping[str, np.ndarray]) -> Belief:
        """Return the belief of a DPS in which the plan in use is the candidate."""
        contents = dps.contents
        self._testbed.dps_layout.check(contents)
        numbers, places = contents.numbers.copy(), self._places
        values = {**believed, _CANDIDATE: numbers[places[_DECISION]], _CANDIDATE_AT: dps.time}
        for name, value in values.items():
            numbers[places[name]] = value
        candidate = self._variables[_CANDIDATE]
        candidate.set(self._context, numbers[places[_CANDIDATE]].reshape(candidate.shape))
        return Belief(replace(dps, contents=replace(contents, numbers=numbers)))


def _in_this_thread(search: SearchConfig) -> SearchConfig:
    """Return the search that a simulation makes in its own thread."""
    if search.executor == "compiled":
        return replace(search, workers=1)
    return replace(search, executor="serial", workers=None)


def _check_arguments(decision: Sequence[Element], budget: Budget, horizon: float, latency: float) -> None:
    if budget.rollouts is None:
        raise ValueError(f"a reasoner on board has a budget of rollouts, such as Budget(rollouts=70), not {budget}")
    for element in decision:
        if not element.address.partition("[")[0].endswith(f".{_CANDIDATE}"):
            raise ValueError(
                f"a reasoner on board decides its own parameter, dps.<path>.{_CANDIDATE}, not {element.address}: "
                "connect its port decision to what the decision is for"
            )
    if not horizon > latency:
        raise ValueError(
            f"a horizon of {horizon:g} s ends before a decision is shown, {latency:g} s after its sample: choose a "
            "longer one"
        )
