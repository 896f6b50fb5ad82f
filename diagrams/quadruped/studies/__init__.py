"""The studies of the quadruped: how hard it may be pushed."""
