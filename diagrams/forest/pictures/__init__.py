"""What a running localization unit looks like: the driver's display, and the picture of the documentation."""
