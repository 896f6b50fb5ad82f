"""A rock-strewn plain of Mars, on which the carrier of the forest localizes itself: its rocks, and the testbed."""
