"""Meta-World tasks and a Jenga tower as zenoh services, and expert demonstrations streamed from them."""

import os

# MuJoCo picks its GL backend when it is imported, so this has to run before any module of the package does.
os.environ.setdefault("MUJOCO_GL", "egl")
# llvmpipe, the software renderer: at 84 x 84 its worker threads cost more than they bring.
os.environ.setdefault("LP_NUM_THREADS", "0")
