"""Tools that every folder may use: arrays, settings, checks of arguments, errors, child processes, Ctrl-C, splines."""
