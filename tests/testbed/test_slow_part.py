"""A slow part in a simulation: when it samples and shows, what it remembers, and how results enter from outside."""

from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource, ZeroOrderHold
from pydrake.systems.sensors import ImageRgba8U

from vtbdrake.state import Codec, collect
from vtbdrake.state import snapshot as snapshots
from vtbdrake.state.snapshot import StateCopier
from vtbdrake.testbed import SlowPart, slow_parts
from vtbdrake.testbed.slow_function import SlowPartError

PERIOD = 0.05
STEP = 0.01


class Time(LeafSystem):
    """Tells the time.

    .. pydrake_system::

        name: Time
        output_ports:
        - t
    """

    def __init__(self) -> None:
        super().__init__()
        self.variables = ()
        self.DeclareVectorOutputPort("t", 1, self._calc)

    def _calc(self, context: Context, output: object) -> None:
        output.SetFromVector([context.get_time()])  # type: ignore[attr-defined]


def square(t):
    return t**2


def summed(t, memory):
    return memory + t, memory + t


class Rig:
    """A slow part whose input ``t`` is the time."""

    def __init__(self, function=square, *, latency, memory=None, offset=0.0, **more):
        builder = DiagramBuilder()
        self.part = builder.AddNamedSystem(
            "part",
            SlowPart(
                function,
                inputs={"t": 1},
                outputs=more.pop("outputs", {"y": 1}),
                period=PERIOD,
                latency=latency,
                memory=memory,
                offset=offset,
                **more,
            ),
        )
        builder.Connect(builder.AddNamedSystem("time", Time()).get_output_port(), self.part.GetInputPort("t"))
        self.diagram: Diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.simulator.Initialize()
        self.context = self.simulator.get_mutable_context()

    def read(self, port, context=None):
        value = self.part.GetOutputPort(port).Eval(self.part.GetMyContextFromRoot(context or self.context))
        return value.item() if isinstance(value, np.ndarray) else value

    def advance(self, t):
        self.simulator.AdvanceTo(t)

    def variables(self):
        return collect(self.diagram)


def expected_samples(t, *, latency, offset=0.0):
    """The times of the samples whose results are shown at t, an instant at which nothing happens."""
    return [offset + k * PERIOD for k in range(1000) if offset + k * PERIOD + latency < t]


@pytest.mark.parametrize(("latency", "offset"), [(0.02, 0.0), (0.05, 0.0), (0.12, 0.0), (0.03, 0.017), (0.4, 0.01)])
def test_a_result_is_shown_one_latency_after_its_sample(latency, offset):
    rig = Rig(latency=latency, offset=offset)
    for n in range(150):
        t = n * STEP + 0.0051
        rig.advance(t)
        samples = expected_samples(t, latency=latency, offset=offset)
        shown = samples[-1] if samples else -np.inf
        assert rig.read("sampled_at") == pytest.approx(shown, abs=1e-12)
        # With an offset, it samples 10 ns early.
        assert rig.read("y") == pytest.approx(shown**2 if samples else 0.0, abs=1e-7)
        assert rig.read("valid") == bool(samples) and rig.read("missed") == 0.0


@pytest.mark.parametrize("start", [0.0, 1e5])
def test_no_sample_and_no_result_is_left_out_however_time_is_advanced(start):
    for latency, offset in [(0.03, 0.0), (0.007, 0.011), (0.019, 0.003), (0.15, 0.05)]:
        calls = []
        rig = Rig(lambda t, calls=calls: calls.append(t.item()) or t, latency=latency, offset=offset)
        rig.context.SetTime(start)
        rig.simulator.Initialize()
        for n in range(5000):
            rig.advance(start + n * 0.001)
        ticks = np.round((np.array(calls) - offset) / PERIOD)
        assert len(ticks) >= 95 and set(np.diff(ticks)) == {1.0}


def test_what_is_updated_at_the_instant_of_a_result_sees_it():
    builder = DiagramBuilder()
    source = builder.AddNamedSystem("source", ConstantVectorSource([3.0]))
    part = SlowPart(square, inputs={"t": 1}, outputs={"y": 1}, period=0.05, latency=0.03)
    builder.AddNamedSystem("part", part)
    hold = builder.AddNamedSystem("hold", ZeroOrderHold(0.03, 1))
    builder.Connect(source.get_output_port(), part.GetInputPort("t"))
    builder.Connect(part.GetOutputPort("y"), hold.get_input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.031)
    assert hold.get_output_port().Eval(hold.GetMyContextFromRoot(simulator.get_context())) == [9.0]


@pytest.mark.parametrize("latency", [0.03, 0.12])
def test_the_memory_goes_from_each_sample_to_the_next(latency):
    rig = Rig(summed, latency=latency, memory=np.zeros(1))
    rig.advance(1.001)
    assert rig.read("y") == pytest.approx(sum(expected_samples(1.001, latency=latency)))


@pytest.mark.parametrize("request_at", [0.0, 0.5])
def test_only_a_request_leads_to_updates(request_at):
    rig = Rig(lambda t, request: t, latency=0.03, on_request=True)
    request, part_context = rig.part.GetInputPort("request"), rig.part.GetMyMutableContextFromRoot(rig.context)
    request.FixValue(part_context, 0.0)
    rig.advance(request_at)
    assert rig.simulator.get_num_unrestricted_updates() == 0
    request.FixValue(part_context, 1.0)
    rig.advance(request_at + 1.001)
    assert rig.simulator.get_num_unrestricted_updates() == 2  # The sample, and its result.
    assert rig.read("taken") == 1.0 and rig.read("sampled_at") == pytest.approx(request_at, abs=PERIOD + 1e-9)


def test_at_first_it_shows_what_was_declared():
    rig = Rig(latency=0.03, initial={"y": [7.0]})
    assert rig.read("y") == 7.0 and rig.read("valid") == 0.0 and rig.read("sampled_at") == -np.inf


def test_an_event_that_is_repeated_after_an_exception_elsewhere_changes_nothing():
    class Sulks(LeafSystem):
        def __init__(self):
            super().__init__()
            self.left = 3
            self.variables = ()
            self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self.update)

        def update(self, context, state):
            if context.get_time() == PERIOD and self.left:
                self.left -= 1
                raise RuntimeError("not now")

    builder = DiagramBuilder()
    source = builder.AddNamedSystem("source", ConstantVectorSource([1.0]))
    part = SlowPart(summed, inputs={"t": 1}, outputs={"y": 1}, period=PERIOD, latency=PERIOD, memory=np.zeros(1))
    builder.AddNamedSystem("part", part)
    builder.AddNamedSystem("sulks", Sulks())
    builder.Connect(source.get_output_port(), part.GetInputPort("t"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(PERIOD)
    for _ in range(3):
        with pytest.raises(RuntimeError, match="not now"):
            simulator.AdvanceTo(0.26)
    kept = snapshots.take(diagram, simulator.get_context(), collect(diagram)).groups
    assert kept["part/abstract/0/ticks"].tolist() == [[1, 0]]
    simulator.AdvanceTo(0.26)
    # The results of the samples at 0, ..., 0.2.
    assert part.GetOutputPort("y").Eval(part.GetMyContextFromRoot(simulator.get_context())) == [5.0]


def test_an_exception_in_the_function_is_one_of_the_simulation():
    def fails(t):
        raise ArithmeticError("no idea")

    rig = Rig(fails, latency=0.03)
    rig.advance(0.029)
    with pytest.raises(ArithmeticError, match="no idea"):
        rig.advance(0.031)


# -- values of all kinds


@dataclass(frozen=True)
class Landmarks:
    p_WL: np.ndarray
    count: int
    sure: bool


def test_abstract_values_come_through_to_the_last_bit():
    image = ImageRgba8U(640, 480)
    rng = np.random.default_rng(0)
    image.mutable_data[:] = rng.integers(0, 256, size=(480, 640, 4), dtype=np.uint8)
    X_WC = RigidTransform(RotationMatrix.MakeXRotation(0.3), [1.0, 2.0, 3.0])

    def see(camera, pose, memory):
        count = memory.count + 1
        landmarks = Landmarks(camera.data[::100, ::200, 0].astype(float), count, True)
        mirrored = ImageRgba8U(640, 480)
        mirrored.mutable_data[:] = camera.data[:, ::-1]
        return {"found": landmarks, "mirrored": mirrored, "back": pose.inverse(), "mean": camera.data.mean()[None]}, (
            Landmarks(landmarks.p_WL, count, False)
        )

    builder = DiagramBuilder()
    nothing = Landmarks(np.zeros((0, 3)), 0, False)
    part = SlowPart(
        see,
        inputs={"camera": ImageRgba8U(640, 480), "pose": RigidTransform()},
        outputs={"found": nothing, "mirrored": ImageRgba8U(640, 480), "back": RigidTransform(), "mean": 1},
        memory=nothing,
        period=PERIOD,
        latency=0.03,
    )
    builder.AddNamedSystem("part", part)
    for name, value in {"camera": image, "pose": X_WC}.items():
        source = builder.AddNamedSystem(name, ConstantValueSource(Value(value)))
        builder.Connect(source.get_output_port(), part.GetInputPort(name))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.081)
    context = part.GetMyContextFromRoot(simulator.get_context())
    shown = {name: part.GetOutputPort(name).Eval(context) for name in ("found", "mirrored", "back", "mean")}
    assert np.array_equal(shown["found"].p_WL, image.data[::100, ::200, 0])
    assert shown["found"].count == 2 and shown["found"].sure is True
    assert np.array_equal(shown["mirrored"].data, image.data[:, ::-1])
    assert np.array_equal(shown["back"].GetAsMatrix34(), X_WC.inverse().GetAsMatrix34())
    assert shown["mean"] == image.data.mean()


def test_a_codec_of_ones_own():
    codec = Codec(lambda text: {"utf8": np.frombuffer(text.encode(), np.uint8)}, lambda a: a["utf8"].tobytes().decode())
    rig = Rig(lambda t: f"at {t[0]:.2f}", latency=0.03, outputs={"text": "?"}, codecs={"text": codec})
    assert rig.read("text") == "?"
    rig.advance(0.081)
    assert rig.read("text") == "at 0.05"


# -- results from outside


def test_a_result_that_is_handed_in_is_shown_when_it_is_due():
    rig = Rig(latency=0.12)
    rig.advance(0.06)
    assert list(rig.part.waiting(rig.context)) == [0, 1]
    rig.part.deliver(rig.context, 1, {"y": np.array([-5.0])})
    assert list(rig.part.waiting(rig.context)) == [0]
    for t, y in [(0.119, 0.0), (0.121, 0.0**2), (0.169, 0.0), (0.171, -5.0), (0.221, 0.1**2)]:
        rig.advance(t)
        assert rig.read("y") == pytest.approx(y)


def test_what_is_handed_in_is_computed_from_what_waits():
    a, b = Rig(summed, latency=0.03, memory=np.zeros(1)), Rig(summed, latency=0.03, memory=np.zeros(1))
    for n in range(1, 100):
        a.advance(n * STEP)
        b.advance(n * STEP)
        for tick, sample in b.part.waiting(b.context).items():
            result = b.part.function({**sample, **b.part.memory(b.context)})
            b.part.deliver(b.context, tick, result)
        assert a.read("y") == b.read("y") and a.read("sampled_at") == b.read("sampled_at")


def test_missing_result_changes_nothing():
    rig = Rig(summed, latency=0.03, memory=np.zeros(1))
    rig.advance(0.10)
    assert (rig.read("y"), rig.read("sampled_at"), rig.read("valid")) == (pytest.approx(0.05), 0.05, 1.0)
    rig.advance(0.11)
    rig.part.deliver(rig.context, 2, {})
    rig.advance(0.14)
    assert (rig.read("y"), rig.read("sampled_at"), rig.read("valid")) == (pytest.approx(0.05), 0.05, 0.0)
    assert rig.read("missed") == 1.0
    rig.advance(0.19)
    assert (rig.read("y"), rig.read("sampled_at"), rig.read("valid")) == (pytest.approx(0.2), pytest.approx(0.15), 1.0)
    assert rig.read("missed") == 1.0


def test_of_a_late_result_only_the_memory_is_taken():
    rig = Rig(summed, latency=0.03, memory=np.zeros(1))
    rig.advance(0.06)
    rig.part.deliver(rig.context, 1, {})
    rig.advance(0.09)
    rig.part.deliver(rig.context, 1, {"y": np.array([100.0]), "memory": np.array([40.0])})
    assert rig.read("y") == 0.0 and rig.read("valid") == 0.0
    rig.advance(0.131)
    assert rig.read("y") == pytest.approx(40.1)


def test_what_was_handed_in_does_not_change_any_more():
    rig = Rig(latency=0.03, outputs={"y": np.zeros(1)})
    rig.advance(0.01)
    result = {"y": np.array([4.0])}
    rig.part.deliver(rig.context, 0, result)
    result["y"][:] = 5.0
    rig.advance(0.04)
    shown = rig.part.GetOutputPort("y").Eval(rig.part.GetMyContextFromRoot(rig.context))
    assert shown == [4.0] and not shown.flags.writeable


@pytest.mark.parametrize(
    ("arrays", "told"),
    [
        ({"x": np.zeros(1)}, "has the arrays memory, y, not x"),
        ({"y": np.zeros(1), "memory.a": np.zeros(1)}, "not y, memory.a"),
        ({"y": np.zeros(2)}, "y has 1 entries, not the shape (2,)"),
    ],
)
def test_a_result_of_another_part_is_refused(arrays, told):
    rig = Rig(summed, latency=0.03, memory=np.zeros(1))
    rig.advance(0.01)
    with pytest.raises(SlowPartError) as error:
        rig.part.deliver(rig.context, 0, arrays)
    assert told in str(error.value) and list(rig.part.waiting(rig.context)) == [0]


# -- copies


def ways_to_copy(rig):
    fresh = rig.diagram.CreateDefaultContext()
    StateCopier(rig.diagram, rig.variables(), rig.diagram, rig.variables()).copy(rig.context, fresh)
    restored = rig.diagram.CreateDefaultContext()
    snapshots.apply(snapshots.take(rig.diagram, rig.context, rig.variables()), rig.diagram, restored, rig.variables())
    return {"clone": rig.context.Clone(), "copier": fresh, "snapshot": restored}


@pytest.mark.parametrize("way", ["clone", "copier", "snapshot"])
def test_a_copy_with_samples_and_results_under_way_goes_on_alike(way):
    rig = Rig(summed, latency=0.12, memory=np.array([0.25]))
    rig.advance(0.26)
    assert list(rig.part.waiting(rig.context)) == [3, 4, 5]
    rig.part.deliver(rig.context, 3, {})
    rig.part.deliver(rig.context, 4, {"y": np.array([8.0]), "memory": np.array([9.0])})
    copy = Simulator(rig.diagram, ways_to_copy(rig)[way])
    shown = []
    for t in (0.28, 0.33, 0.38, 0.43):
        rig.advance(t)
        copy.AdvanceTo(t)
        shown.append(rig.read("y"))
        for port in ("y", "sampled_at", "valid", "missed"):
            assert rig.read(port, copy.get_context()) == rig.read(port)
    # 0 + 0.05 + 0.1 + 0.25 is what was remembered before; then one is missing, one was handed in.
    assert shown == pytest.approx([0.4, 8.0, 9.25, 9.55])


def test_a_snapshot_tells_what_differs_under_way():
    rig = Rig(latency=0.12)
    rig.advance(0.06)
    before = snapshots.take(rig.diagram, rig.context, rig.variables())
    rig.part.deliver(rig.context, 1, {"y": np.array([1.0])})
    assert before.compare(snapshots.take(rig.diagram, rig.context, rig.variables()))
    again = rig.diagram.CreateDefaultContext()
    snapshots.apply(before, rig.diagram, again, rig.variables())
    assert not before.compare(snapshots.take(rig.diagram, again, rig.variables()))


def test_its_outputs_have_addresses():
    rig = Rig(latency=0.03, outputs={"y": 1})
    assert set(rig.variables()) == {"part.y", "part.sampled_at", "part.valid", "part.missed"}
    rig.advance(0.09)
    assert rig.variables()["part.y"].get(rig.context) == pytest.approx(0.05**2)


def test_slow_parts_are_found_in_the_dps():
    inner, outer = DiagramBuilder(), DiagramBuilder()
    rig = {"inputs": {"t": 1}, "outputs": {"y": 1}, "period": 0.1, "latency": 0.1}
    part = inner.AddNamedSystem("part", SlowPart(square, **rig))
    inner.ExportInput(part.GetInputPort("t"), "t")
    outer.AddNamedSystem("dps", inner.Build())
    outer.AddNamedSystem("elsewhere", SlowPart(square, **rig))
    assert slow_parts(outer.Build()) == {"dps.part": part}


# -- bad input


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"period": 0.0}, "period of a slow part is finite, and at least 1e-06, not 0.0"),
        ({"latency": -1.0}, "latency of a slow part is finite, and at least 1e-06, not -1.0"),
        ({"latency": np.nan}, "latency of a slow part is finite, and at least 1e-06, not nan"),
        ({"offset": -0.1}, "not at -0.1 s"),
        ({"period": "0.1"}, "the period of a slow part must be a number, not '0.1'"),
        ({"initial": {"y": ["1.5"]}}, "y: an array of numbers is expected here, not ['1.5']"),
        ({"latency": 17 * PERIOD}, "17 samples of a slow part would be under way"),
        ({"patience": 0.0}, "patience of a slow part is finite, and at least 1e-06, not 0.0"),
        ({"inputs": {}}, "at least one input"),
        ({"outputs": {"a.b": 1}}, "not 'a.b'"),
        ({"outputs": {"valid": 1}}, "not 'valid'"),
        ({"outputs": {"y": 0}}, "y of a slow part has at least one entry, not 0"),
        ({"outputs": {"t": 1}}, "different names, but both have t"),
        ({"outputs": {"y": object()}}, "y of a slow part: there is no codec for a object"),
        ({"initial": {"z": [1.0]}}, "initial names no output of the slow part: z"),
        ({"initial": {"y": [1.0, 2.0]}}, "y: an array of shape (1,) is expected here, not one of shape (2,)"),
        (
            {"codecs": {"t": Codec(dict, dict)}},
            "a codec is for an abstract port or the memory of a slow part, not for t",
        ),
    ],
)
def test_a_slow_part_that_cannot_be_is_refused(changed, told):
    arguments = {"inputs": {"t": 1}, "outputs": {"y": 1}, "period": PERIOD, "latency": 0.03, **changed}
    with pytest.raises(ValueError) as error:
        SlowPart(square, **arguments)
    assert told in str(error.value)


@pytest.mark.parametrize(
    ("function", "more", "told"),
    [
        (lambda t: {"z": t}, {}, "a slow part returns its outputs by name (y), not z"),
        (lambda t: t, {"outputs": {"y": 1, "z": 1}}, "a slow part returns its outputs by name (y, z), not array([0.])"),
        (lambda t: np.zeros(3), {}, "y: an array of shape (1,) is expected here, not one of shape (3,)"),
        (lambda t: ["1.5"], {}, "y: an array of numbers is expected here, not ['1.5']"),
        (lambda t: "?", {}, "y: an array of numbers is expected here, not '?'"),
        (lambda t, memory: t, {"memory": np.zeros(1)}, "returns (outputs, memory), not array([0.])"),
    ],
)
def test_a_function_that_returns_something_else_is_told_of(function, more, told):
    rig = Rig(function, latency=0.03, **more)
    with pytest.raises(SlowPartError) as error:
        rig.advance(0.031)
    assert told in str(error.value)
