"""Sizes of observations."""

IMAGE_SIZE = 84
"""Height and width of every image, in pixels."""
