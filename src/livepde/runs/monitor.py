"""Outputs of a live run: log, JSON lines, /health, and /metrics for Prometheus."""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TextIO

from livepde import __version__
from livepde.errors import RunError, optional
from livepde.estimate import Estimate
from livepde.library_messages import OneLine
from livepde.runs.backlog import Sink
from livepde.runs.web import Address, Server
from livepde.verdict import NUMBERS

if TYPE_CHECKING:
    from wsgiref.types import StartResponse, WSGIEnvironment

    from prometheus_client.core import Metric


def configure(kind: str = "text", level: int = logging.INFO) -> None:
    """Configure logging of messages of livepde and warnings of other libraries to standard error.

    The loggers are livepde.run, livepde.mqtt and livepde.opcua. In JSON, an event of the run has
    the fields kind, channel and t.

    `kind`: "text", or "json" for one object per line, with the time in UTC.
    `level`: lowest level of the messages of livepde.
    Raises `RunError`: the package python-json-logger is not installed.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    if kind == "json":
        with optional("service", "A log in JSON needs python-json-logger", RunError):
            from pythonjsonlogger.json import JsonFormatter
        names = "%(asctime)s %(levelname)s %(name)s %(message)s"
        renamed = {"asctime": "time", "levelname": "level", "name": "logger"}
        lines = JsonFormatter(names, datefmt="%Y-%m-%dT%H:%M:%SZ", rename_fields=renamed)
        lines.converter = time.gmtime
        handler.setFormatter(lines)
    handler.addFilter(OneLine())
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    logging.getLogger("livepde").setLevel(level)
    # asyncua logs each lost connection with a traceback; livepde.opcua logs it in one line.
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)


@dataclass(eq=False)
class JsonLinesSink(Sink):
    """Sink that writes each estimate as a line of JSON, see `Estimate.to_dict`."""

    stream: TextIO

    def put(self, estimate: Estimate) -> None:
        """Write an estimate.

        Raises `OSError`: the reader has closed the stream, or its disk is full.
        """
        line = json.dumps(estimate.to_dict(), allow_nan=False)
        try:
            print(line, file=self.stream, flush=True)
        except OSError:
            # Redirect the stream to the null device: flushing its buffer at exit would fail again.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            with suppress(OSError):
                os.dup2(nowhere, self.stream.fileno())
            os.close(nowhere)
            raise


class Metrics(Sink):
    """Estimates as Prometheus metrics; a sink of a run.

    `livepde_estimate{unknown}`, `livepde_deviation{unknown}`, `livepde_innovation{sensor}`,
    `livepde_model_time_seconds`, `livepde_last_sample_timestamp_seconds`, `livepde_samples_total`,
    `livepde_failed_steps_total`, `livepde_build_info{version}`, `livepde_unknown_info{unknown,
    unit}`. A `Monitor` adds the health of its run: `livepde_ok`, `livepde_unwell{why}`,
    `livepde_silent`, `livepde_waiting_samples`, `livepde_verdict`, `livepde_step_seconds_total`,
    `livepde_remarks_total{kind, channel}`.

    `sensors`: names of the sensors.
    `second`: one second in the model's unit of time.
    """

    def __init__(self, sensors: Iterable[str], second: float = 1.0) -> None:
        with optional("service", "Metrics need prometheus-client", RunError):
            from prometheus_client import CollectorRegistry, Counter, Gauge
        self.registry = CollectorRegistry()

        def gauge(name: str, about: str, *labels: str) -> Gauge:
            return Gauge(f"livepde_{name}", about, labels, registry=self.registry)

        self._sensors = tuple(sensors)
        self._estimate = gauge("estimate", "Estimated unknown, in its unit", "unknown")
        about = "Standard deviation of an unknown, in its unit"
        self._deviation = gauge("deviation", about, "unknown")
        about = "Measured minus predicted of the last sample, in the unit of the sensors"
        self._innovation = gauge("innovation", about, "sensor")
        about = "Time of the last sample since the start of the model"
        self._time = gauge("model_time_seconds", about)
        about = "When the last sample was processed, in seconds since 1970"
        self._stamp = gauge("last_sample_timestamp_seconds", about)
        build = gauge("build_info", "1, with the version of the program", "version")
        build.labels(__version__).set(1)
        self._unit = gauge("unknown_info", "1, with the unit of an unknown", "unknown", "unit")
        self._second = second
        self._samples = Counter("livepde_samples", "Samples processed", registry=self.registry)
        self._failed = Counter("livepde_failed_steps", "Steps that failed", registry=self.registry)

    def put(self, estimate: Estimate) -> None:
        for label, (value, std) in estimate.parameters.items():
            self._estimate.labels(label).set(value)
            self._deviation.labels(label).set(std)
            self._unit.labels(label, estimate.space.unknown_of(label).unit).set(1)
        for name, value in zip(self._sensors, estimate.innovation.tolist(), strict=True):
            self._innovation.labels(name).set(value)
        self._time.set(estimate.t / self._second)
        self._stamp.set_to_current_time()
        self._samples.inc()
        if not estimate.status.ok:
            self._failed.inc()


@dataclass(frozen=True, eq=False)
class _Health:
    """Collector of metrics from the health of a run at the time of each request."""

    health: Callable[[], Mapping[str, Any]]

    def collect(self) -> Iterator[Metric]:
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        found = self.health()
        for name, key, text in (
            ("ok", "ok", "1 while samples arrive, are accepted, and steps succeed"),
            ("silent", "silent", "1 while no data arrive from the source"),
            ("waiting_samples", "waiting", "Samples waiting for their step"),
        ):
            if key in found:
                yield GaugeMetricFamily(f"livepde_{name}", text, float(found[key]))
        if found.get("verdict") in NUMBERS:
            text = ", ".join(f"{number} {level}" for level, number in NUMBERS.items())
            level = float(NUMBERS[found["verdict"]])
            yield GaugeMetricFamily("livepde_verdict", text, level)
        # The kind is the label: each sentence would start a new time series.
        about = "1 with the kind of the reason, if any; /health has the sentence"
        unwell = GaugeMetricFamily("livepde_unwell", about, labels=["why"])
        if ailment := str(found.get("ailment", "")):
            unwell.add_metric([ailment], 1.0)
        yield unwell
        if "seconds" in found:
            text = "Seconds spent in steps"
            yield CounterMetricFamily("livepde_step_seconds", text, found["seconds"])
        text = "Rows, values and samples that were late, malformed, missing, merged, ..."
        remarks = CounterMetricFamily("livepde_remarks", text, labels=["kind", "channel"])
        for kind, channel, number in found.get("counts", ()):
            remarks.add_metric([kind, channel], number)
        yield remarks


class Monitor(Server):
    """Server of /livez, /readyz, /health and /metrics, in its own threads.

    /livez returns 200 while the process runs. /readyz and /health return 200 while the run is
    healthy, else 503. /readyz also returns 503 while a resumed run replays samples. The verdict
    does not affect these codes: it is in the content of /health, and a metric.

    `health`: function that returns the content of /health; its "ok" determines the code, 200 or
    503, and its "why" is the content of /readyz.
    Raises `RunError`: the port is taken.
    """

    def __init__(
        self, address: Address, health: Callable[[], Mapping[str, Any]], metrics: Metrics
    ) -> None:
        from prometheus_client import make_wsgi_app

        self._health = health
        metrics.registry.register(_Health(health))
        self._metrics = make_wsgi_app(metrics.registry)
        super().__init__(self._answer, address)

    def _answer(self, environ: WSGIEnvironment, start: StartResponse) -> Iterable[bytes]:
        path = environ.get("PATH_INFO", "/")
        if path == "/metrics":
            answer: Iterable[bytes] = self._metrics(environ, start)
            return answer
        plain = [("Content-Type", "text/plain")]
        if path == "/livez":
            start("200 OK", plain)
            return [b"ok\n"]
        if path not in ("/health", "/readyz"):
            start("404 Not Found", plain)
            return [b"There are /livez, /readyz, /health and /metrics.\n"]
        found = dict(self._health())
        code = "200 OK" if found.get("ok") else "503 Service Unavailable"
        if path == "/readyz":
            waits = found.get("why") or found.get("replaying")
            start("503 Service Unavailable" if waits else code, plain)
            return [f"{waits or 'ok'}\n".encode()]
        start(code, [("Content-Type", "application/json")])
        return [json.dumps(found).encode()]
