"""Meta-World tasks and a Jenga tower as zenoh services, and expert demonstrations streamed from them."""

import os

# Set before any module of the package is imported, since MuJoCo reads these on import. Empty variables count as unset:
# MuJoCo takes them for the backend that needs a display, or for a malformed number.
for _variable in ("MUJOCO_GL", "MUJOCO_EGL_DEVICE_ID", "LP_NUM_THREADS"):
    if not os.environ.get(_variable):
        os.environ.pop(_variable, None)
os.environ.setdefault("MUJOCO_GL", "egl")
# Threads of llvmpipe, the software renderer: at 84 x 84 pixels they cost more than they save.
os.environ.setdefault("LP_NUM_THREADS", "0")
