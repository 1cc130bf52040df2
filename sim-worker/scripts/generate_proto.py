"""Generates the Python messages and gRPC stubs of `proto/` into `src/cpn/v1`."""

import sys
from importlib.resources import files
from pathlib import Path

from grpc_tools import protoc

PACKAGE = Path(__file__).resolve().parents[1]
PROTO = PACKAGE.parent / "proto"
OUTPUT = PACKAGE / "src"


def main() -> int:
    """Runs protoc; returns its exit code."""
    sources = sorted(str(path) for path in PROTO.glob("cpn/v1/*.proto"))
    # Only these have gRPC services: a stub file for each of the other protos would be empty.
    services = [path for path in sources if path.endswith(("planner.proto", "training.proto"))]
    includes = [f"-I{PROTO}", f"-I{files('grpc_tools') / '_proto'}"]
    messages = protoc.main(["", *includes, f"--python_out={OUTPUT}", f"--pyi_out={OUTPUT}", *sources])
    return messages or protoc.main(["", *includes, f"--grpc_python_out={OUTPUT}", *services])


if __name__ == "__main__":
    sys.exit(main())
