"""The library of testbeds, one folder each. Imported from the checkout, not part of the wheel."""
