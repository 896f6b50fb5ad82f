"""A casadi.Function as a system: its values, its derivatives, what it depends on, and what it refuses."""

import gc
import pickle
import threading
import weakref

import casadi
import numpy as np
import pytest
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.analysis import Simulator, Simulator_
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, Sine

from vtbdrake.components.casadi_system import CasadiSystem
from vtbdrake.state import collect
from vtbdrake.state.systems import is_python

Q, V, GAIN = casadi.SX.sym("q", 2), casadi.SX.sym("v", 2), casadi.SX.sym("gain", 2)
X, U, A, T = casadi.SX.sym("x", 2), casadi.SX.sym("u", 2), casadi.SX.sym("A", 2, 2), casadi.SX.sym("t")

# It is not symmetric: the order of its entries matters.
A0 = np.array([[0.9, 0.2], [-0.1, 0.7]])


def _law():
    torque = -GAIN[0] * casadi.sin(Q) - GAIN[1] * V
    return casadi.Function("law", [Q, V, GAIN], [torque, casadi.dot(V, V)], ["q", "v", "gain"], ["torque", "power"])


def _recursion():
    update = casadi.Function(
        "update", [X, U, A, T], [A @ X + casadi.sin(U) * T, X @ X.T], ["x", "u", "A", "t"], ["x_next", "P_next"]
    )
    output = casadi.Function("output", [X, U, A], [2 * X, A @ U, A], ["x", "u", "A"], ["twice", "seen", "matrix"])
    state = {"x": [1.0, -2.0], "P": np.zeros((2, 2))}
    return CasadiSystem(output, update=update, state=state, period=0.1, parameters={"A": A0}, time="t")


def _in_context(system, **inputs):
    context = system.CreateDefaultContext()
    for name, value in inputs.items():
        system.GetInputPort(name).FixValue(context, value)
    return context


def _eval(system, context, name):
    return system.GetOutputPort(name).Eval(context)


def test_ports_and_parameters_have_the_names_and_values_of_the_function():
    system = CasadiSystem(_law(), parameters={"gain": casadi.DM([3.0, 4.0])})
    q, v = np.array([0.3, -0.4]), np.array([1.0, 2.0])
    context = _in_context(system, q=q, v=v)
    np.testing.assert_allclose(_eval(system, context, "torque"), -3.0 * np.sin(q) - 4.0 * v, rtol=1e-15)
    np.testing.assert_allclose(_eval(system, context, "power"), [5.0], rtol=1e-15)
    context.get_mutable_numeric_parameter(0).SetFromVector([0.0, 1.0])
    np.testing.assert_allclose(_eval(system, context, "torque"), -v, rtol=1e-15)
    assert is_python(system)


def test_update_is_the_recursion_and_matrices_travel_row_after_row():
    system, u = _recursion(), np.array([0.3, 0.7])
    context = _in_context(system, u=u)
    Simulator(system, context).AdvanceTo(0.75)
    x, P = np.array([1.0, -2.0]), np.zeros((2, 2))
    for k in range(8):
        x, P = A0 @ x + np.sin(u) * 0.1 * k, np.outer(x, x)
    np.testing.assert_allclose(context.get_discrete_state(0).value(), x, rtol=1e-13)
    np.testing.assert_allclose(context.get_discrete_state(1).value(), P.ravel(), rtol=1e-13)
    np.testing.assert_allclose(_eval(system, context, "twice"), 2.0 * x, rtol=1e-13)
    np.testing.assert_allclose(_eval(system, context, "seen"), A0 @ u, rtol=1e-13)
    np.testing.assert_array_equal(_eval(system, context, "matrix"), A0.ravel())


def test_states_that_follow_from_each_other_change_at_once():
    a, b = casadi.SX.sym("a", 2), casadi.SX.sym("b", 2)
    exchange = casadi.Function("exchange", [a, b], [b, a], ["a", "b"], ["a_next", "b_next"])
    system = CasadiSystem(update=exchange, state={"a": [1.0, 2.0], "b": [3.0, 4.0]}, period=0.1)
    context = system.CreateDefaultContext()
    Simulator(system, context).AdvanceTo(0.25)
    assert [context.get_discrete_state(i).value().tolist() for i in (0, 1)] == [[3.0, 4.0], [1.0, 2.0]]


def test_without_an_output_the_states_are_the_ports():
    update = casadi.Function("hold", [U], [U], ["u"], ["torque_next"])
    system = CasadiSystem(update=update, state={"torque": [0.0, 5.0]}, period=0.1)
    context = _in_context(system, u=[1.0, 2.0])
    np.testing.assert_array_equal(_eval(system, context, "torque"), [0.0, 5.0])
    Simulator(system, context).AdvanceTo(0.05)
    np.testing.assert_array_equal(_eval(system, context, "torque"), [1.0, 2.0])
    assert not system.HasAnyDirectFeedthrough()


def test_state_and_parameters_are_variables_by_address():
    system = CasadiSystem(
        casadi.Function("output", [X, A, T], [X + T], ["x", "A", "offset"], ["y"]),
        update=casadi.Function("update", [X, A], [A @ X], ["x", "A"], ["x_next"]),
        state={"x": [1.0, 2.0]},
        period=0.1,
        parameters={"A": A0, "offset": 0.5},
        units={"x": "m", "offset": "m"},
        bounds={"offset": (0.0, 1.0)},
    )
    builder = DiagramBuilder()
    builder.AddNamedSystem("filter", system)
    diagram = builder.Build()
    variables, context = collect(diagram), diagram.CreateDefaultContext()
    np.testing.assert_array_equal(variables["filter.A"].get(context), A0)
    assert variables["filter.offset"].get(context) == 0.5
    assert (variables["filter.offset"].unit, variables["filter.offset"].bounds) == ("m", (0.0, 1.0))
    variables.write(context, {"filter.A": [[0.9, 9.0], [-0.1, 0.7]], "filter.offset": 1.0, "filter.x": [3.0, 4.0]})
    own = system.GetMyContextFromRoot(context)
    np.testing.assert_array_equal(own.get_numeric_parameter(0).value(), [0.9, 9.0, -0.1, 0.7, 1.0])
    np.testing.assert_array_equal(_eval(system, own, "y"), [4.0, 5.0])


def test_autodiff_carries_the_analytic_derivatives():
    system = CasadiSystem(_law(), parameters={"gain": [3.0, 4.0]}).ToAutoDiffXd()
    q, v = np.array([0.3, -0.4]), np.array([1.0, 2.0])
    # Derivatives by three decision variables; the third one also moves a gain.
    dq, dv = np.array([[1.0, 0.0, 2.0], [0.5, 1.0, 0.0]]), np.array([[0.0, 3.0, 0.0], [1.0, 0.0, 1.0]])
    context = _in_context(
        system, q=InitializeAutoDiff(q, gradient=dq).ravel(), v=InitializeAutoDiff(v, gradient=dv).ravel()
    )
    context.get_mutable_numeric_parameter(0).SetFromVector([AutoDiffXd(3.0, [0.0, 0.0, 1.0]), AutoDiffXd(4.0)])
    torque = _eval(system, context, "torque")
    np.testing.assert_allclose(ExtractValue(torque).ravel(), -3.0 * np.sin(q) - 4.0 * v, rtol=1e-15)
    expected = -3.0 * np.cos(q)[:, None] * dq - 4.0 * dv - np.outer(np.sin(q), [0.0, 0.0, 1.0])
    np.testing.assert_allclose(ExtractGradient(torque), expected, rtol=1e-14)
    np.testing.assert_allclose(ExtractGradient(_eval(system, context, "power")), 2.0 * v[None] @ dv, rtol=1e-14)


def test_autodiff_through_the_updates_agrees_with_finite_differences():
    def final(z):
        autodiff = z.dtype == object
        system = _recursion().ToAutoDiffXd() if autodiff else _recursion()
        context = _in_context(system, u=z[:2])
        context.SetDiscreteState(0, z[2:])
        (Simulator_[AutoDiffXd] if autodiff else Simulator)(system, context).AdvanceTo(0.45)
        return np.concatenate([context.get_discrete_state(i).CopyToVector() for i in range(2)])

    z, h = np.array([0.3, 0.7, 1.0, -2.0]), 1e-6
    differences = np.transpose([(final(z + h * e) - final(z - h * e)) / (2 * h) for e in np.eye(4)])
    result = final(InitializeAutoDiff(z).ravel())
    np.testing.assert_allclose(ExtractGradient(result), differences, atol=1e-8)
    np.testing.assert_array_equal(ExtractValue(result).ravel(), final(z))


def _index(kind):
    """Functions with results whose dependence is easily missed: no derivative, or none by sparsity."""
    a, b = kind.sym("a"), kind.sym("b", 3)
    results = [casadi.floor(a) * b[0], casadi.if_else(a > 1, b, 2 * b), casadi.sign(a - 1), b, kind(a - a) + b[2]]
    if kind is casadi.MX:
        results += [b[a], casadi.low(b, a)]
    return casadi.Function("tricky", [a, b], results, ["a", "b"], [f"y{k}" for k in range(len(results))])


@pytest.mark.parametrize("kind", [casadi.SX, casadi.MX])
def test_direct_feedthrough_is_where_the_result_changes(kind):
    function, rng = _index(kind), np.random.default_rng(1)
    system = CasadiSystem(function)
    for k in range(function.n_out()):
        changes = [False, False]
        for _ in range(50):
            point = [rng.uniform(0, 2), np.sort(rng.uniform(0, 2, 3))]
            for i, other in enumerate((rng.uniform(0, 2), np.sort(rng.uniform(0, 2, 3)))):
                moved = [*point[:i], other, *point[i + 1 :]]
                changes[i] |= bool(casadi.norm_inf(function.call(point)[k] - function.call(moved)[k]) > 0)
        assert [system.HasDirectFeedthrough(i, k) for i in range(2)] == changes, function.name_out(k)


def test_an_input_that_has_no_derivative_is_no_less_an_input():
    function = casadi.Function("opaque", [U], [2 * U], ["u"], ["y"], {"is_diff_in": [False], "never_inline": True})
    system = CasadiSystem(function)
    context = _in_context(system, u=[1.0, 2.0])
    _eval(system, context, "y")
    system.get_input_port().FixValue(context, [3.0, 4.0])
    np.testing.assert_array_equal(_eval(system, context, "y"), [6.0, 8.0])


class _Counter(casadi.Callback):
    """x -> 2 x, and how often."""

    def __init__(self):
        super().__init__()
        self.count = 0
        self.construct("counter", {})

    def get_sparsity_in(self, i):
        return casadi.Sparsity.dense(2)

    def get_sparsity_out(self, i):
        return casadi.Sparsity.dense(2)

    def eval(self, arguments):
        self.count += 1
        return [2 * arguments[0]]


def test_an_output_of_the_state_follows_the_state_alone():
    counter, x, u = _Counter(), casadi.MX.sym("x", 2), casadi.MX.sym("u", 2)
    system = CasadiSystem(
        casadi.Function("output", [x, u], [counter(x), u], ["x", "u"], ["y", "seen"]),
        update=casadi.Function("update", [x, u], [x + u], ["x", "u"], ["x_next"]),
        state={"x": [1.0, 2.0]},
        period=0.1,
    )
    context = _in_context(system, u=[0.0, 0.0])
    for k in range(5):
        context.SetTime(0.01 * k)
        system.get_input_port().FixValue(context, [1.0, k])
        np.testing.assert_array_equal(_eval(system, context, "y"), [2.0, 4.0])
    assert counter.count == 1
    context.SetDiscreteState([3.0, 4.0])
    np.testing.assert_array_equal(_eval(system, context, "y"), [6.0, 8.0])
    assert counter.count == 2


def test_an_output_of_the_time_follows_it():
    system = CasadiSystem(casadi.Function("clock", [T], [casadi.sin(T)], ["t"], ["y"]), time="t")
    context = system.CreateDefaultContext()
    for time in (0.0, 0.3, 0.7):
        context.SetTime(time)
        np.testing.assert_allclose(_eval(system, context, "y"), [np.sin(time)], rtol=1e-15)
    converted = system.ToAutoDiffXd()
    context = converted.CreateDefaultContext()
    context.SetTime(AutoDiffXd(0.3, [2.0]))
    np.testing.assert_allclose(_eval(converted, context, "y")[0].derivatives(), [2.0 * np.cos(0.3)], rtol=1e-15)


def test_a_constant_result_needs_nothing():
    system = CasadiSystem(casadi.Function("constant", [U], [casadi.DM([1, 2]), 0 * U], ["u"], ["y", "zero"]))
    context = system.CreateDefaultContext()
    np.testing.assert_array_equal(_eval(system, context, "y"), [1.0, 2.0])
    np.testing.assert_array_equal(_eval(system, context, "zero"), [0.0, 0.0])
    converted = system.ToAutoDiffXd()
    assert [y.value() for y in _eval(converted, converted.CreateDefaultContext(), "y")] == [1.0, 2.0]


def _long():
    """Takes much longer than what surrounds it, so that threads meet in it, and forgets nothing: it is chaotic."""
    x, u = casadi.SX.sym("x", 20), casadi.SX.sym("u")
    y = x
    for _ in range(1500):
        y = (3.8 + 0.1 * u) * y * (1.0 - y)
    return casadi.Function("long", [x, u], [y], ["x", "u"], ["x_next"])


def test_threads_compute_what_one_thread_computes():
    builder = DiagramBuilder()
    source = builder.AddSystem(Sine(1.0, 3.0, 0.0, 1))
    system = builder.AddSystem(CasadiSystem(update=_long(), state={"x": np.zeros(20)}, period=0.001))
    builder.Connect(source.get_output_port(0), system.get_input_port())
    diagram = builder.Build()

    def final(start):
        simulator = Simulator(diagram)
        context = simulator.get_mutable_context()
        context.SetDiscreteState(np.linspace(start, 0.9, 20))
        simulator.AdvanceTo(0.05)
        return np.array(context.get_discrete_state_vector().CopyToVector())

    starts = [0.1 + 0.1 * k for k in range(6)]
    alone, together = [final(start) for start in starts], {}
    threads = [threading.Thread(target=lambda s=s: together.update({s: final(s)})) for s in starts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for start, expected in zip(starts, alone, strict=True):
        np.testing.assert_array_equal(together[start], expected)


class _Foresight(LeafSystem):
    """Evaluates a system in another context of its own, as a planner does."""

    def __init__(self, system):
        super().__init__()

        def calc(context, output):
            output.SetFromVector(_eval(system, _in_context(system, q=[5.0, 6.0], v=[7.0, 8.0]), "torque"))

        self.DeclareVectorOutputPort("v", 2, calc)


def test_reading_an_input_may_evaluate_the_same_system():
    builder = DiagramBuilder()
    system = builder.AddSystem(CasadiSystem(_law(), parameters={"gain": [3.0, 4.0]}))
    q = builder.AddSystem(ConstantVectorSource([0.3, -0.4]))
    nested = builder.AddSystem(_Foresight(system))
    builder.Connect(q.get_output_port(), system.GetInputPort("q"))
    builder.Connect(nested.get_output_port(), system.GetInputPort("v"))
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    inner = -3.0 * np.sin([5.0, 6.0]) - 4.0 * np.array([7.0, 8.0])
    expected = -3.0 * np.sin([0.3, -0.4]) - 4.0 * inner
    np.testing.assert_allclose(_eval(system, system.GetMyContextFromRoot(root), "torque"), expected, rtol=1e-15)


def test_a_function_that_was_sent_to_another_process_gives_the_same():
    law = _law()
    contexts = []
    for function in (law, pickle.loads(pickle.dumps(law))):
        system = CasadiSystem(function, parameters={"gain": [3.0, 4.0]})
        contexts.append(_eval(system, _in_context(system, q=[0.1, 0.2], v=[0.3, 0.4]), "torque"))
    np.testing.assert_array_equal(*contexts)


def test_an_input_without_a_source_is_named():
    system = CasadiSystem(_law(), parameters={"gain": [3.0, 4.0]})
    with pytest.raises(RuntimeError, match="v.*not connected"):
        _eval(system, _in_context(system, q=[0.1, 0.2]), "torque")


class _Failing(_Counter):
    def eval(self, arguments):
        raise ArithmeticError("no solution")


def test_a_function_that_fails_is_an_error():
    x, failing = casadi.MX.sym("x", 2), _Failing()
    system = CasadiSystem(casadi.Function("output", [x], [failing(x)], ["x"], ["y"]))
    with pytest.raises(Exception, match="counter"):
        _eval(system, _in_context(system, x=[1.0, 2.0]), "y")


_UPDATE = casadi.Function("update", [X, U], [X + U], ["x", "u"], ["x_next"])
_OUTPUT = casadi.Function("output", [X, U], [X - U], ["x", "u"], ["y"])
_STATE = {"x": [0.0, 0.0]}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "give output, update, or both"),
        ({"output": len}, "output is a casadi.Function, not <built-in function len>"),
        (
            {"output": casadi.Function("f", [X], [X + U], ["x"], ["y"], {"allow_free": True})},
            "f has the free variables 'u_0', 'u_1': make them arguments",
        ),
        ({"output": _OUTPUT, "parameters": {"gian": 1.0}}, "parameter 'gian': no such argument; there are 'x', 'u'"),
        ({"output": _OUTPUT, "time": "t"}, "time 't': no such argument"),
        ({"output": _OUTPUT, "time": "u"}, "time is a scalar, but the argument 'u' is 2x1"),
        ({"output": _OUTPUT, "units": {"u": "m"}}, "units of 'u': no such argument; there are none"),
        ({"output": _OUTPUT, "parameters": {"u": [1, 2, 3]}}, r"has a value of shape \(3,\), but is 2x1"),
        ({"output": _OUTPUT, "parameters": {"u": ["1", "2"]}}, r"'u' must be a number or several, not \['1', '2'\]"),
        ({"output": _OUTPUT, "state": _STATE}, "the state 'x' never changes: give update"),
        ({"output": _OUTPUT, "period": 0.1}, "period is 0.1 s, but there is no update"),
        ({"update": _UPDATE, "state": _STATE}, "period is None s, but update needs a positive one"),
        ({"update": _UPDATE, "state": _STATE, "period": 0.0}, "period is 0.0 s, but update needs a positive one"),
        ({"update": _UPDATE, "period": 0.1}, "update needs state"),
        ({"update": _OUTPUT, "state": _STATE, "period": 0.1}, "output gives 'y', but .* are expected: 'x_next'"),
        ({"update": _UPDATE, "state": {"x": [1.0]}, "period": 0.1}, r"state 'x' has a value of shape \(1,\)"),
        (
            {"update": _UPDATE, "state": _STATE, "period": 0.1, "parameters": {"x": [1, 2]}},
            "'x' is state and parameter, but can be one thing only",
        ),
        (
            {"update": casadi.Function("f", [X], [X.T], ["x"], ["x_next"]), "state": _STATE, "period": 0.1},
            "the state 'x' is 2x1, but 'x_next' is 1x2",
        ),
        (
            {
                "output": casadi.Function("f", [A], [A], ["u"], ["y"]),
                "update": _UPDATE,
                "state": _STATE,
                "period": 0.1,
            },
            "the argument 'u' is 2x2 in output, but 2x1 in update",
        ),
    ],
)  # fmt: skip
def test_what_does_not_fit_together_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        CasadiSystem(**arguments)


def test_arguments_are_dense_and_nothing_is_empty():
    L = casadi.SX.sym("L", casadi.Sparsity.lower(2))
    with pytest.raises(ValueError, match="f: the argument 'L' is 2x2,3nz, but must be dense and have entries"):
        CasadiSystem(casadi.Function("f", [L], [L], ["L"], ["y"]))
    nothing = casadi.SX.sym("nothing", 0)
    with pytest.raises(ValueError, match="f: the argument 'nothing' is 0x1,0nz, but must be dense and have entries"):
        CasadiSystem(casadi.Function("f", [X, nothing], [X], ["x", "nothing"], ["y"]))
    with pytest.raises(ValueError, match="f: the result 'y' is empty"):
        CasadiSystem(casadi.Function("f", [X], [casadi.SX(0, 1)], ["x"], ["y"]))


def test_expressions_are_not_freed_by_whichever_thread_collects_garbage():
    gc.collect()  # What other tests have left.
    system = CasadiSystem(_law(), parameters={"gain": [2.0, 0.5]})
    cycle = [system]
    cycle.append(cycle)
    expressions = [weakref.ref(each) for each in gc.get_objects() if isinstance(each, casadi.SX) and each.numel() == 2]
    others = {id(each()) for each in expressions}
    del system, cycle
    collector = threading.Thread(target=gc.collect)
    collector.start()
    collector.join()
    assert {id(each()) for each in expressions} == others
    CasadiSystem(_law(), parameters={"gain": [2.0, 0.5]})
    assert any(each() is None for each in expressions)
