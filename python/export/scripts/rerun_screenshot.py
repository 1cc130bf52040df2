# /// script
# requires-python = ">=3.11"
# dependencies = ["rerun-sdk==0.41.0"]
# ///
"""Screenshot of Rerun's viewer with a recording, on a virtual display.

Needs the Debian packages xauth, xvfb and mesa-vulkan-drivers.

uv run --script scripts/rerun_screenshot.py RECORDING.mcap PICTURE.png
"""

import subprocess
import sys
from pathlib import Path

TIMEOUT_SECONDS = 120


def main() -> None:
    """Saves the screenshot."""
    try:
        recording, picture = (Path(argument) for argument in sys.argv[1:])
    except ValueError:
        sys.exit("usage: rerun_screenshot.py RECORDING.mcap PICTURE.png")
    # The screen is large enough that the pointer, at its middle, is outside the window, which is in the upper left and
    # twice as large in pixels as requested.
    screen = ["xvfb-run", "--auto-servernum", "--server-args", "-screen 0 5000x3200x24"]
    viewer = [str(Path(sys.executable).with_name("rerun")), "--bind", "127.0.0.1", "--port", "auto"]
    options = ["--window-size", "1200x760", "--screenshot-to", str(picture), str(recording)]
    subprocess.run([*screen, *viewer, *options], check=True, timeout=TIMEOUT_SECONDS)
    if not picture.exists():
        sys.exit(f"{picture}: expected the viewer to write it, and it did not")


if __name__ == "__main__":
    main()
