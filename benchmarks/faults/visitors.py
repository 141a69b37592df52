"""Visitors that ask slowly: /health answers all the same."""

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
PAUSE = 0.2  # seconds between two questions
SOON = 1.0  # seconds


def slow_visitors(plan: Plan) -> Outcome:
    """Hold connections open that send a line now and then, and ask for /health beside them."""
    monitor = Monitor(Address(), lambda: {"ok": True}, Metrics(["a"]))
    slow = [socket.create_connection(("127.0.0.1", monitor.port)) for _ in range(VISITORS)]
    answers = []
    for one in slow:
        one.sendall(b"GET / HTTP/1.1\r\n")
    for k in range(ROUNDS):
        for one in slow:
            with suppress(OSError):
                one.sendall(b"X-%d: 1\r\n" % k)
        begun = time.monotonic()
        with urllib.request.urlopen(f"{monitor.url}health", timeout=60.0) as answer:
            answer.read()
        answers.append(time.monotonic() - begun)
        time.sleep(PAUSE)
    for one in slow:
        one.close()
    monitor.close()
    rows = [(VISITORS, ROUNDS, round(max(answers), 3))]
    columns = ("slow connections", "questions", "longest answer (s)")
    return Outcome(
        tables=[Table("Slow visitors beside /health", columns, rows)],
        checks=[Check("slow visitors: longest answer of /health (s)", max(answers), SOON, "<=")],
    )
