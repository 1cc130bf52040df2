"""Recorded demonstrations as datasets of other robot-learning tools."""
