"""Workarounds for faults of Drake and pydrake, a module for each, which says what is wrong and where it is reported.

| module | works around | may go when |
|---|---|---|
| `step_watch` | integrators try steps for ever where time derivatives are NaN | they give up at their shortest step |
| `lost_interrupts` | pydrake drops a Ctrl-C while it converts arguments | it passes exceptions of conversions on |
| `making` | threads that make contexts wait for each other, in a warning | warnings reach Python without a lock |
| `event_times` | rounding skips periodic events that have an offset | no event is skipped |
| `cenic` | a step of length zero ends the process; fixed steps leave old poses | Drake 1.58 is the oldest supported |
| `kept_meshcats` | a Meshcat ends the process in another thread; its server dies | it may end in any thread |
| `renderer_threads` | a thread that has ended keeps its renderer from being ended elsewhere | threads let go of it |
| `schunk_wsg`, `schunk_kernel` | the gripper's controller keeps its motion outside the Context | the motion is state |

Faults whose remedy is part of something larger, and where that is:

* The garbage collector cannot free a system in Python whose output ports call its methods, nor the Diagram around it
  (https://github.com/RobotLocomotion/drake/issues/24162): `vtbdrake.state.declarations.weakly`.
* It visits the dict of an instance of a class derived from LeafSystem twice, and then cannot free it either: `NO_DICT`,
  there.
* pydrake keeps a context alive for ever if it is the result of GetMyContextFromRoot on itself: a root context is
  recognized without it in `vtbdrake.testbed.addressed`.
* A failed assertion in Drake raises SystemExit, which `except Exception` does not catch
  (https://github.com/RobotLocomotion/drake/issues/7827): `vtbdrake.common.failures.FAILURES`.
* Drake's configs cannot be pickled: `vtbdrake.testbed.scenario` registers how. Nor can the metaclass of pydrake's
  classes: `vtbdrake.common.pickling`.
* Nor can pydrake's functions be pickled, such as AddMultibodyPlantSceneGraph: `vtbdrake.common.pickling`, too.
* SetDefaultContext leaves deformable bodies as they are in Drake 1.51: `vtbdrake.testing.checks.repetition_checks` does
  not ask for it.
* pydrake has a PortSwitch for vectors only: `vtbdrake.testbed.switch.AbstractSwitch`.

``tests/drake_workarounds`` holds the smallest reproduction of each. A reproduction that fails with the oldest supported
version of Drake says that its workaround may go.
"""
