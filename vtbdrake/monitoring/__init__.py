"""Monitoring of a running loop: residuals against a model, and live values for other processes."""
