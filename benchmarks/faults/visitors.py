"""Slow clients, which must not delay /health."""

from __future__ import annotations

import socket
import time
import urllib.request
from contextlib import suppress

from benchmarks.faults.plan import Plan
from livepde.runs import Check, Outcome, Table
from livepde.runs.monitor import Metrics, Monitor
from livepde.runs.web import Address

VISITORS, ROUNDS = 60, 10
PAUSE = 0.2  # seconds between two requests
SOON = 1.0  # time limit of an answer, in seconds


def slow_visitors(plan: Plan) -> Outcome:
    """Request /health while many open connections send a line now and then."""
    monitor = Monitor(Address(), lambda: {"ok": True}, Metrics(["a"]))
    slow = [socket.create_connection(("127.0.0.1", monitor.port)) for _ in range(VISITORS)]
    answers = []
    for client in slow:
        client.sendall(b"GET / HTTP/1.1\r\n")
    for k in range(ROUNDS):
        for client in slow:
            with suppress(OSError):
                client.sendall(b"X-%d: 1\r\n" % k)
        begun = time.monotonic()
        with urllib.request.urlopen(f"{monitor.url}health", timeout=60.0) as answer:
            answer.read()
        answers.append(time.monotonic() - begun)
        time.sleep(PAUSE)
    for client in slow:
        client.close()
    monitor.close()
    rows = [(VISITORS, ROUNDS, round(max(answers), 3))]
    columns = ("slow connections", "questions", "longest answer (s)")
    return Outcome(
        tables=[Table("Slow visitors beside /health", columns, rows)],
        checks=[Check("slow visitors: longest answer of /health (s)", max(answers), SOON, "<=")],
    )
