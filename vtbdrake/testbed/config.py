"""Drake's configs as plain dataclasses: with their field names, but they pickle, so that a scenario can travel."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from pydrake.systems.analysis import SimulatorConfig

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlantConfig


@dataclass
class SimulatorFields:
    """Fields of Drake's SimulatorConfig that decide the trajectory."""

    # Name of an integration scheme, as in `pydrake.systems.analysis.GetIntegrationSchemes()`.
    integration_scheme: str = "runge_kutta3"
    # Largest step, in seconds.
    max_step_size: float = 0.1
    # Accuracy of error-controlled schemes.
    accuracy: float = 1e-4
    # Whether the scheme controls its error by choosing its steps.
    use_error_control: bool = True

    def config(self) -> SimulatorConfig:
        """Drake's config of the same values."""
        return SimulatorConfig(**asdict(self))


@dataclass
class PlantFields:
    """Fields of Drake's MultibodyPlantConfig."""

    # Step of a discrete plant in seconds; 0 makes it continuous.
    time_step: float = 0.0
    use_sampled_output_ports: bool = True
    penetration_allowance: float = 0.001
    stiction_tolerance: float = 0.0001
    contact_model: str = "hydroelastic_with_fallback"
    discrete_contact_approximation: str = "lagged"
    sap_near_rigid_threshold: float = 1.0
    contact_surface_representation: str = "polygon"
    adjacent_bodies_collision_filters: bool = True

    def config(self) -> MultibodyPlantConfig:
        """Drake's config of the same values."""
        from pydrake.multibody.plant import MultibodyPlantConfig

        return MultibodyPlantConfig(**asdict(self))
