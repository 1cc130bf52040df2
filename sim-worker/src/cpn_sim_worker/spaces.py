"""Sizes of what a policy sees."""

IMAGE_SIZE = 84
"""Height and width of every image, in pixels."""
