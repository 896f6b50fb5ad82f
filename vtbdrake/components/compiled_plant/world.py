"""A compiled plant as a System: the simulated world of a mental testbed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import casadi
import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from vtbdrake.components.casadi_system import CasadiSystem
from vtbdrake.components.compiled_plant.dynamics import PlantDynamics, plant_step
from vtbdrake.components.compiled_plant.links import input_name
from vtbdrake.state.declarations import DISCRETE, PARAMETER, Element
from vtbdrake.state.multibody import element_address, multibody_variables

_TOLERANCE = 1e-9
_CHECKS = 3


def compiled_world(
    plant: MultibodyPlant, context: Context, *, inputs: Sequence[str] = (), compile: bool | None = None
) -> CasadiSystem:
    r"""Return a System that moves as a discrete, contact-free plant, and has its ports ``actuation`` and ``state``.

    .. pydrake_system::

        name: CasadiSystem
        input_ports:
        - actuation
        output_ports:
        - state
        - overrun (if the plant has joint stops)

    Its variables are the joints' positions and velocities, and the inputs. They have the addresses of the plant's, if
    one model instance of it moves and the System is added to a testbed as ``sim.sys.<model instance>``: beliefs and
    parameters fit both. ``overrun`` is the largest one since the begin: once it is positive, the joint stops, which are
    left out, would have acted; see `plant_step`.

    Args:
        plant: The plant, finalized, with a time step; it is not kept.
        context: Its own Context, with the initial state and the parameters.
        inputs: Addresses within the plant of the values that become parameters; see `read_links`.
        compile: Whether to make machine code; see `CasadiSystem`.

    Raises:
        UnsupportedPlantError: The plant has contact, loops, springs, joints of other types, and so on.
        ValueError: An input is not among the addresses.
        ArithmeticError: The compiled step is not that of the plant.
    """
    step = plant_step(plant, context, inputs=inputs)
    defaults = PlantDynamics(plant, context, inputs=inputs).values
    _check(plant, context, step, list(defaults.values()))
    x0 = plant.GetPositionsAndVelocities(context)
    x, u, *further_inputs = step.sx_in()
    overrun = casadi.SX.sym("overrun")
    x_next, beyond = step.call([x, u, *further_inputs])
    names, arguments, following = ["state"], [x], {"state_next": x_next}
    state = {"state": x0}
    if np.isfinite([plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()]).any():
        names, arguments = [*names, "overrun"], [*arguments, overrun]
        following["overrun_next"] = casadi.fmax(overrun, beyond)
        state["overrun"] = float(step(x0, np.zeros(u.numel()), *defaults.values())[1])
    update = casadi.Function(
        "world",
        [*arguments, u, *further_inputs],
        list(following.values()),
        [*names, "actuation", *step.name_in()[2:]],
        list(following),
    )
    world = CasadiSystem(
        update=update,
        state=state,
        period=plant.time_step(),
        parameters={input_name(address): value for address, value in defaults.items()},
        compile=compile,
    )
    world.variables = (*_elements(plant, inputs), *(e for e in world.variables if e.name == "overrun"))
    return world


def _elements(plant: MultibodyPlant, inputs: Sequence[str]) -> Iterator[Element]:
    """Yield the elements of [q; v] and the inputs, named as the plant's variables."""
    listed = {variable.address: variable for variable in multibody_variables(plant, prefix=_no_prefix)}
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    places: dict[str, int] = {}
    for joint in joints:
        if joint.num_velocities():
            address = element_address(plant, joint, _no_prefix)
            places[f"{address}.position"] = joint.position_start()
            places[f"{address}.velocity"] = plant.num_positions() + joint.velocity_start()
    instances = {plant.GetModelInstanceName(joint.model_instance()) for joint in joints if joint.num_velocities()}
    common = f"{instances.pop().replace('::', '.')}." if len(instances) == 1 else ""
    for address, start in places.items():
        v = listed[address]
        yield Element(address.removeprefix(common), DISCRETE, 0, v.shape, start, v.unit, v.bounds)
    start = 0
    for address in inputs:
        v = listed[address]
        yield Element(address.removeprefix(common), PARAMETER, 0, v.shape, start, v.unit, v.bounds)
        start += int(np.prod(v.shape))


def _no_prefix(instance: str) -> str:
    return ""


def _check(
    plant: MultibodyPlant, context: Context, step: casadi.Function, inputs: Sequence[NDArray[np.float64]]
) -> None:
    """Compare steps of the plant and of the function from states near that of the Context."""
    random = np.random.default_rng(0)
    x0, nq = plant.GetPositionsAndVelocities(context), plant.num_positions()
    for _ in range(_CHECKS):
        trial = context.Clone()
        x = x0.copy()
        x[nq:] += 0.1 * random.standard_normal(plant.num_velocities())
        u = random.standard_normal(plant.num_actuated_dofs())
        trial.SetTime(0.0)
        plant.SetPositionsAndVelocities(trial, x)
        plant.get_actuation_input_port().FixValue(trial, u)
        following, overrun = (value.full().ravel() for value in step(x, u, *inputs))
        if overrun > 0.0:
            continue  # The plant feels a joint stop.
        simulator = Simulator(plant, trial)
        simulator.AdvanceTo(plant.time_step())
        expected = plant.GetPositionsAndVelocities(simulator.get_context())
        difference = np.max(np.abs(following - expected)) / max(1.0, np.max(np.abs(expected)))
        if not difference <= _TOLERANCE:
            raise ArithmeticError(
                f"the compiled step differs from the plant's by {difference:.2g}, relative to its state; "
                "is something connected to the plant beside its actuation?"
            )
