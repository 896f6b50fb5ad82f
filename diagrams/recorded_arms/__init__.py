"""Arms and legs of which there are recordings: calibrated, and compared with what others have published."""
