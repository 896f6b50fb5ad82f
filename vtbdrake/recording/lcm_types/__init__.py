"""LCM types of the recorder's own channels; lcm-gen makes the modules from ``vtb_log.lcm``."""
