"""LCM types of what a recorder writes: `vtb_log.lcm`, and what lcm-gen makes of it."""
