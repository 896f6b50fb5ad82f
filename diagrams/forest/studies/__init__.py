"""Studies of the localization unit, and the trials and recordings by which it is judged."""
