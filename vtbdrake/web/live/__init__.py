"""A testbed, a log or a loop in a thread of its own, and its page, where it is watched, changed and driven."""
