"""Headsets that open a live page lead a robot."""
