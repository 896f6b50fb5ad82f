"""Pictures of a running localization unit: the driver's display, and the picture of the documentation."""
