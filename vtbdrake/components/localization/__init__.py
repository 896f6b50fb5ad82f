"""Localization of a carrier by landmarks that stand in the ground: trunks, rocks."""
