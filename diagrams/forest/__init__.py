"""A forest machine that localizes itself among trees: the testbed, its world, its studies and its pictures."""
