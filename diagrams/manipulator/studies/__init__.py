"""The studies of the arm: its controllers compared (C1), its calibration, and the validity of its model."""
