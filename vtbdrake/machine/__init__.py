"""The machine: a simulation of the physical robot in a separate process.

It contains the world and the LCM protocol of the scenario, and nothing of the controller. The maps of the
`vtbdrake.lcm.protocol.Protocol` make the bridge of the controller and, read in the other direction, the machine.

* **Cycles.** At the time k periods it sends its state: one message per channel of ``Protocol.sense``, with the time
  ``epoch + k periods``. Then it simulates the period that begins, under the newest command that has arrived: with the
  wall clock, by k periods; in lock-step, where it waits for the answer to its state, when there is one message on every
  command channel.
* **Its own safety.** It checks commands as any machine does: type, length, finite values, the limits of the signals,
  newer than the last. After ``timeout`` seconds without a command it brakes until the next one, and also before the
  first command. However it brakes, a commanded position is held.
* **Differences from the simulated world**: perturbed parameters, values that are set, noise on sensors, latencies both
  ways. All random numbers come from one seed.
* **Injected faults** on request, by LCM or by a `MachineProcess`: see `injected_faults` and `MachineLoop`.
"""

from vtbdrake.common.lazy_names import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)
