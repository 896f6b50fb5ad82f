"""Arms and legs with recordings: calibrated, and compared with what others have published."""
