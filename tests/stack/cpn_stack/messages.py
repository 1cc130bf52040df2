"""The messages of `proto/`, made as they are needed."""

import tempfile
from typing import Any

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message_factory import GetMessages
from grpc_tools import protoc

from cpn_stack.stack import ROOT


def _messages() -> dict[str, Any]:
    with tempfile.NamedTemporaryFile() as file:
        options = [f"-I{ROOT}/proto", f"--descriptor_set_out={file.name}", "--include_imports"]
        assert protoc.main(["", *options, "cpn/v1/planner.proto"]) == 0
        return GetMessages(FileDescriptorSet.FromString(file.read()).file)


_MESSAGES = _messages()


def message(name: str, **fields: object) -> Any:
    """A message of the package `cpn.v1`."""
    return _MESSAGES[f"cpn.v1.{name}"](**fields)


def decode(name: str, payload: bytes) -> Any:
    """A message from its bytes."""
    return _MESSAGES[f"cpn.v1.{name}"].FromString(payload)
