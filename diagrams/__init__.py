"""The example testbeds, one folder each, imported as `vtbdrake_diagrams`: PyPI has another package `diagrams`."""
