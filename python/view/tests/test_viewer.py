import socket
import urllib.request

import psutil
import pytest

from cpn_view.error import ViewError
from cpn_view.viewer import ViewerConfig, serve
from tests.support import free_port


def test_serves_on_the_loopback_interface_only() -> None:
    port = free_port(2)
    with serve(ViewerConfig(port=port)) as viewer:
        assert viewer.url == f"http://127.0.0.1:{port}/?url=rerun+http://127.0.0.1:{port + 1}/proxy"
        with urllib.request.urlopen(viewer.url) as page:  # noqa: S310
            assert b"<title>Rerun Viewer</title>" in page.read()
        connections = psutil.Process(viewer.process.pid).net_connections()
        listening = {tuple(c.laddr) for c in connections if c.status == psutil.CONN_LISTEN}
        assert listening == {("127.0.0.1", port), ("127.0.0.1", port + 1)}
    assert viewer.process.poll() is not None


def test_server_that_ends() -> None:
    with serve(ViewerConfig(port=free_port(2))) as viewer:
        viewer.check()
        viewer.process.kill()
        viewer.process.wait()
        with pytest.raises(ViewError, match="rerun: expected a running server, got exit status -9"):
            viewer.check()


@pytest.mark.parametrize("taken", [0, 1])
def test_port_is_taken(taken: int) -> None:
    port = free_port(2)
    with (
        socket.create_server(("127.0.0.1", port + taken)),
        pytest.raises(ViewError, match=f"--port: expected two free ports, got {port + taken}: Address already in use"),
        serve(ViewerConfig(port=port)),
    ):
        pass


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"port": 65535}, "--port: expected 1 to 65534, got 65535"),
        ({"memory_limit_mib": 0}, "--memory-limit-mib: expected at least 1, got 0"),
        ({"bind": "localhost"}, "--bind: expected an IP address, got 'localhost'"),
        ({"bind": "10.0.0.1"}, "--bind: expected an address of the loopback interface, or --insecure, got 10.0.0.1"),
    ],
)
def test_wrong_options(options: dict[str, int], error: str) -> None:
    with pytest.raises(ViewError, match=error):
        ViewerConfig(**options)  # pyright: ignore[reportArgumentType]
