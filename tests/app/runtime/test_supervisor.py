"""What listens for the service."""

import socket

import pytest

from app.runtime.supervisor import listen
from lensmodel.core.errors import InvalidInputError


def test_no_answer_waits_for_a_receipt_of_its_head() -> None:
    with listen("127.0.0.1", 0) as listener, socket.create_connection(listener.getsockname()):
        connection, _ = listener.accept()
        with connection:
            assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_a_port_that_is_taken_is_named() -> None:
    with listen("127.0.0.1", 0) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(InvalidInputError, match=f"127.0.0.1:{port}"):
            listen("127.0.0.1", port)
