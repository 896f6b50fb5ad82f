"""Whether a recording can begin."""

from __future__ import annotations

from vtbdrake.control.runtime import Runtime


def check_recordable(runtime: Runtime) -> None:
    """
    Raises:
        ValueError: a replay could not repeat what this loop does from now on.
    """
    context, bridge, diagram = runtime.context, runtime.bridge, runtime.target.diagram
    if runtime.steps and context.num_continuous_states() and runtime.target.simulator_fields.use_error_control:
        raise ValueError(
            f"the integrator has a memory of the {runtime.steps} steps that were, which no replay would have: begin to "
            "record before the first step, or switch error control off"
        )
    for signal in runtime.target.interface.sense:
        if signal.is_vector:
            continue
        if signal.name not in bridge.channels:
            raise ValueError(
                f"sensor signal {signal.name} is abstract, and is recorded by its raw messages, which "
                f"{type(bridge).__name__} does not have: make it a vector, or use a bridge with raw messages"
            )
        if bridge.sensed[signal.name].count or diagram.GetInputPort(f"real.sense.{signal.name}").HasValue(context):
            raise ValueError(
                f"sensor signal {signal.name} is abstract, and the message with its present value was not recorded: "
                "begin to record before the bridge is opened"
            )
