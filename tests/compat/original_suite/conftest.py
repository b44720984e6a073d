"""What the original's test-suite asks for, which its archive has not: here our programs serve in place of its own."""

import os
import subprocess
import sys

import pytest


def serve(*words):
    """Starts our program, and waits until it says that it serves."""
    program = subprocess.Popen(
        [os.environ["ZTL_COMMAND"], *words], stderr=subprocess.PIPE, text=True
    )
    heard = []
    for line in program.stderr:
        heard.append(line)
        if "Registering controller" in line:
            return program
    program.wait()
    pytest.fail("".join(heard))


@pytest.fixture(scope="class")
def ztl_simple_server():
    program = serve("simple-server", "7777", "/test")
    yield
    program.kill()
    program.wait()


@pytest.fixture(scope="class")
def ztl_server():
    """A server that refuses what the suite asks it for."""
    program = serve("task-server", "-p", "7778", "-s", "/other")
    yield
    program.kill()
    program.wait()


@pytest.fixture(scope="class")
def ztl_data(request):
    request.cls.msg = {"scope": "/test", "state": "1", "id": "-1", "payload": "a;b;c"}
    request.cls.task = {"handler": "h", "component": "c", "goal": "a:b;c — grüße"}


@pytest.fixture(scope="class")
def ztl_subscriber():
    """The suite's publisher needs nobody who listens."""


def pytest_sessionfinish(session, exitstatus):
    session.config.ended = exitstatus


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config):
    """The original's publisher leaves a thread behind that never ends, and Python would wait for it."""
    sys.stdout.flush()
    os._exit(config.ended)
