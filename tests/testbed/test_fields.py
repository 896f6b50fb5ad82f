"""Fields of a scenario set by name: what a rollout varies when a variable will not do."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig

from tests.testbeds import AcrobotScenario
from vtbdrake.testbed import ScenarioError


@dataclass
class Varied(AcrobotScenario):
    gait: str = "tripod"
    legs: int = 6
    stops: bool = False
    height: "float | None" = None
    places: list[float] = field(default_factory=lambda: [1.0, 2.0])

    def validate(self):
        super().validate()
        if self.legs < 4:
            raise ScenarioError(f"Varied.legs must be at least 4, not {self.legs}")


def test_fields_are_set_in_a_copy_nested_ones_too():
    scenario = Varied()
    values = {
        "gait": "wave",
        "legs": 8,
        "stops": True,
        "height": 0.5,
        "period": 0.04,
        "simulator_config.accuracy": 1e-3,
    }
    changed = scenario.with_fields(values)
    expected = Varied(SimulatorConfig(accuracy=1e-3, max_step_size=0.05), 0.04, 0.0, "wave", 8, True, 0.5)
    assert changed == expected
    assert type(changed) is Varied
    assert scenario == Varied()
    assert changed.places is not scenario.places


@pytest.mark.parametrize(
    ("name", "given", "kept"),
    [
        ("period", 1, 1.0),
        ("period", np.float64(0.5), 0.5),
        ("period", np.int64(2), 2.0),
        ("period", np.array(0.5), 0.5),
        ("height", 2, 2.0),
        ("legs", np.int64(4), 4),
        ("stops", np.bool_(True), True),
        ("gait", np.str_("wave"), "wave"),
    ],
)
def test_what_is_meant_is_taken_as_pythons_own_type(name, given, kept):
    value = getattr(Varied().with_fields({name: given}), name)
    assert value == kept
    assert type(value) is type(kept)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"gaitt": "wave"}, "Varied has no field 'gaitt' .*did you mean scenario.gait"),
        (
            {"simulator_config.acuracy": 1.0},
            "did you mean scenario.simulator_config.accuracy",
        ),
        ({"simulator_config": SimulatorConfig()}, "no field 'simulator_config'"),
        ({"places": [1.0]}, "no field 'places'"),
        ({"legs": 6.0}, "Varied.legs takes a value of type int, not 6.0 of type float"),
        ({"legs": True}, "type int, not True of type bool"),
        ({"period": True}, "type float, not True of type bool"),
        ({"period": "fast"}, "type float, not 'fast' of type str"),
        ({"period": [0.1]}, "type float, not .* of type list"),
        ({"height": None}, "type float, not None"),
        ({"gait": 3}, "type str, not 3 of type int"),
        ({"stops": 1}, "type bool, not 1 of type int"),
        ({"legs": 3}, "must be at least 4, not 3"),
        ({"period": float("nan")}, "Varied.period must be finite"),
    ],
)
def test_what_does_not_fit_is_refused(values, message):
    with pytest.raises(ScenarioError, match=message):
        Varied().with_fields(values)
