"""Planner that answers as a test says, over real zenoh and gRPC."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import grpc
import zenoh
from conftest import free_port

from cpn.v1 import planner_pb2, planner_pb2_grpc, types_pb2

Answer = Callable[[planner_pb2.PlanRequest], planner_pb2.PlanResponse | types_pb2.Error]


@contextmanager
def zenoh_planner(answer: Answer) -> Iterator[str]:
    """Planner at the yielded endpoint, with a thread for each query."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")

    def plan(query: zenoh.Query) -> None:
        def reply() -> None:
            assert query.payload
            response = answer(planner_pb2.PlanRequest.FromString(query.payload.to_bytes()))
            if isinstance(response, types_pb2.Error):
                query.reply_err(response.SerializeToString(), encoding="application/protobuf;cpn.v1.Error")
            else:
                query.reply(query.key_expr, response.SerializeToString())
            query.drop()

        threading.Thread(target=reply).start()

    def list_models(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, b"")

    with zenoh.open(config) as session:
        session.declare_queryable("cpn/@v1/planner/planner/plan", plan, complete=True)
        session.declare_queryable("cpn/@v1/planner/planner/list_models", list_models, complete=True)
        yield endpoint


@contextmanager
def grpc_planner(answer: Answer) -> Iterator[str]:
    """Planner at the yielded address."""

    class Servicer(planner_pb2_grpc.PlannerServiceServicer):
        def Plan(  # noqa: N802
            self, request: planner_pb2.PlanRequest, context: grpc.ServicerContext
        ) -> planner_pb2.PlanResponse:
            response = answer(request)
            if isinstance(response, types_pb2.Error):
                context.set_trailing_metadata((("grpc-status-details-bin", response.SerializeToString()),))
                context.abort(grpc.StatusCode.UNKNOWN, "")
            return response

        def ListModels(self, request: object, context: object) -> planner_pb2.ListModelsResponse:  # noqa: N802
            return planner_pb2.ListModelsResponse()

    with ThreadPoolExecutor() as threads:
        server = grpc.server(threads)
        planner_pb2_grpc.add_PlannerServiceServicer_to_server(Servicer(), server)
        port = server.add_insecure_port("127.0.0.1:0")
        server.start()
        yield f"grpc://127.0.0.1:{port}"
        server.stop(None).wait()


FAKES = {"zenoh": zenoh_planner, "grpc": grpc_planner}
