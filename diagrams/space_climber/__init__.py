"""A six-legged walking robot in the style of DFKI's SpaceClimber, and its testbed."""
