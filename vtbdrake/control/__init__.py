"""Section 6: the testbed as the controller of the real machine."""
