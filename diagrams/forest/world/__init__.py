"""The simulated world: stands of trees on uneven ground, maps of them with errors, and the carrier with its driver."""
