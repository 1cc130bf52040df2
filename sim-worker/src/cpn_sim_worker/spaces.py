"""Sizes of what a policy sees and does."""

IMAGE_SIZE = 84
"""Height and width of every image, in pixels."""

ACTION_SIZE = 4
"""Hand displacement x, y, z and gripper effort, each in [-1, 1]; a displacement of 1 is 1 cm."""
