"""Export of recorded demonstrations to the dataset formats of other robot-learning tools."""
