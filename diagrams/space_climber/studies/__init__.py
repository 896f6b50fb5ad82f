"""The studies of the space climber, applications O4 and R1, and a problem file of its gait."""
