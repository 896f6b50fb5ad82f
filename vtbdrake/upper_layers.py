"""What methods hand over to upper layers: the table is `upper_layers.pyi`.

A sweep plots itself, a testbed is shown on a page, a scenario is deployed: users find the method at the object, and a
package above does the work. It is imported when the method is called. Modules below import an upper layer nowhere else,
neither in a function nor for types alone.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub("vtbdrake", __file__)
