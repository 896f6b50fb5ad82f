"""Perception: poses from markers and laser points, and a filter for a tumbling body."""
