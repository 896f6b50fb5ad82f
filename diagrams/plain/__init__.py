"""A planetary plain with rocks, on which the carrier of the forest localizes itself."""
