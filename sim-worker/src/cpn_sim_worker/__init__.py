"""Meta-World tasks and a Jenga tower as zenoh services, and expert demonstrations streamed from them."""

import os

# Read when MuJoCo is imported, so this has to run before any module of the package does. An empty one counts as unset:
# MuJoCo takes it for the backend that needs a display, or for a malformed number.
for _variable in ("MUJOCO_GL", "MUJOCO_EGL_DEVICE_ID", "LP_NUM_THREADS"):
    if not os.environ.get(_variable):
        os.environ.pop(_variable, None)
os.environ.setdefault("MUJOCO_GL", "egl")
# llvmpipe, the software renderer: at 84 x 84 its worker threads cost more than they bring.
os.environ.setdefault("LP_NUM_THREADS", "0")
