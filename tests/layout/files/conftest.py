"""Sandbox processes that are forked from one with the libraries, whose import takes longer than reading a small file."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile

import pytest

from foveasim._io import sandbox

#: Fork a process for each task that arrives with the files of its standard input and output, and a socket for its exit
#: code. The process between them waits for it, so that several can run at the same time.
SERVER = """
import json, os, runpy, signal, socket, sys
import gdstk, numpy  # noqa: F401

server = socket.socket(fileno=int(sys.argv[1]))
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
while True:
    message, files, _, _ = socket.recv_fds(server, 2**16, 3)
    if not message:
        break
    if os.fork():
        for file in files:
            os.close(file)
        continue
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    answer = socket.socket(fileno=files[2])
    process = os.fork()
    if process:
        answer.send(process.to_bytes(8, "little"))
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        answer.send(code.to_bytes(8, "little", signed=True))
        os._exit(0)
    task = json.loads(message)
    os.setsid()
    for number, file in enumerate((files[0], files[1], os.open(os.devnull, os.O_RDWR))):
        os.dup2(file, number)
    os.closerange(3, 64)
    os.environ.clear()
    os.environ.update(task["environment"])
    try:
        sys.argv = [task["script"]]
        runpy.run_path(task["script"], run_name="__main__")
        sys.stdout.flush()
    except BaseException:
        os._exit(1)
    os._exit(0)
"""


class Forked:
    """The process of a task, with the methods of :class:`subprocess.Popen` that the sandbox uses."""

    def __init__(self, answer):
        self._answer, self.returncode = answer, None
        self.pid = int.from_bytes(answer.recv(8), "little")

    def wait(self, timeout=None):
        if self.returncode is None:
            self._answer.settimeout(timeout)
            try:
                self.returncode = int.from_bytes(self._answer.recv(8), "little", signed=True)
            except TimeoutError:
                raise subprocess.TimeoutExpired("sandbox", timeout) from None
            self._answer.close()
        return self.returncode

    def kill(self):
        if self.returncode is None:
            os.kill(self.pid, signal.SIGKILL)


@pytest.fixture(scope="session")
def server():
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with there:
        process = subprocess.Popen([sys.executable, "-P", "-c", SERVER, str(there.fileno())], pass_fds=[there.fileno()])
    with here, process:
        yield here
        here.shutdown(socket.SHUT_RDWR)


@pytest.fixture
def forked_readers(server, monkeypatch):
    """Fork the processes that read files; the tests of the sandbox, of malformed files and of commands start them."""

    def start(task, output, directory):
        about = {"script": sandbox.COMMAND[-1], "environment": {"TMPDIR": directory, **sandbox.ENVIRONMENT}}
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with tempfile.TemporaryFile() as file, there:
            file.write(task)
            file.seek(0)
            socket.send_fds(server, [json.dumps(about).encode()], [file.fileno(), output.fileno(), there.fileno()])
        return Forked(here)

    monkeypatch.setattr(sandbox, "_start", start)
