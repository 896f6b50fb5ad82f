"""The studies of the satellite, applications O1, O2, O3 and R2, and a campaign of captures."""
