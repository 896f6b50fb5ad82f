"""LCM types of our own for commands u; lcm-gen makes the modules from ``vtb_command.lcm``."""
