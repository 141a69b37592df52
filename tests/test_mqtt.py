"""A real broker: rows come, are acknowledged when they are safe, and come again after a crash."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import threading
import time
from pathlib import Path

import pytest
from test_live import live, rows

import livepde as lp
from livepde.streams.mqtt import Broker, MqttSink, MqttSource

pytest.importorskip("paho.mqtt")
MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin")
pytestmark = pytest.mark.skipif(MOSQUITTO is None, reason="needs the broker mosquitto")


class Server:
    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.config = folder / "mosquitto.conf"
        self.config.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous true\npersistence true\n"
            f"persistence_location {folder}/\nautosave_interval 1\nautosave_on_changes true\n"
            "max_queued_messages 0\nuser root\n"
        )
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(
            [str(MOSQUITTO), "-c", str(self.config)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for _ in range(100):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.05)
        raise RuntimeError("mosquitto does not listen")

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait(10)


@pytest.fixture
def server(tmp_path):
    folder = tmp_path / "broker"
    folder.mkdir()
    running = Server(folder)
    yield running
    running.stop()


def source(server: Server, topics=None) -> MqttSource:
    broker = Broker("127.0.0.1", server.port)
    return MqttSource(broker, topics or {"rod": None}, "t")


def publish(server: Server, messages, topic: str = "rod") -> None:
    client = Broker("127.0.0.1", server.port).client("-plant")
    Broker("127.0.0.1", server.port, "plant").connect(client)
    for message in messages:
        text = message if isinstance(message, str) else json.dumps(message)
        client.publish(topic, text, qos=1).wait_for_publish(10)
    client.disconnect()
    client.loop_stop()


def until(run, count: int) -> None:
    """Run until so many samples have been estimated."""

    class Counter:
        seen = 0

        def put(self, estimate):
            self.seen += 1
            if self.seen >= count:
                run.stopping.set()

        def close(self):
            pass

    run.sinks = [*run.sinks, Counter()]
    run.stopping.clear()
    alarm = threading.Timer(30.0, run.stopping.set)
    alarm.start()
    run.run()
    alarm.cancel()


def test_what_was_not_safe_comes_again(server, tmp_path):
    first = source(server)
    publish(server, [*list(rows(30)), "{", '{"t": "x"}'])
    run = live(tmp_path, first)
    until(run, 12)
    first.close()  # the other messages were received, not acknowledged
    run.journal.close()
    server.stop()
    server.start()
    publish(server, list(rows(40))[30:])
    again = live(tmp_path, source(server))
    again.resume()
    until(again, 28)
    assert [round(record.t, 6) for record in again.journal] == [
        round(0.1 * k, 6) for k in range(40)
    ]
    again.feed.close()


def test_numbers_with_topics_of_their_own(server):
    heard = source(server, {"plant/a": "a", "plant/+/level": "b"})
    publish(server, ["1.5", '{"value": 2.5, "t": 7}', "warm"], "plant/a")
    publish(server, ["3"], "plant/x/level")
    found = []
    for _ in range(20):
        found += heard.poll(0.2)
        if len(found) == 4:
            break
    heard.close()
    assert found[0].values["a"] == 1.5
    assert found[1].values == {"t": 7, "a": 2.5}
    assert "not a number" in found[2].broken
    assert found[3].values["b"] == 3


def test_estimates_are_published(server, tmp_path):
    heard = source(server, {"rod/out": None, "rod/out/k": "k"})
    publisher = MqttSink(Broker("127.0.0.1", server.port, "sink"), "rod/out")
    run = live(tmp_path, source_of_rows(), sinks=[publisher])
    run.run()
    publisher.close()
    found = []
    for _ in range(50):
        found += heard.poll(0.2)
        if len(found) == 10:
            break
    heard.close()
    objects = [row.values for row in found if "innovation" in row.values]
    assert [row["t"] for row in objects] == pytest.approx([0.1 * k for k in range(5)])
    assert objects[-1]["k"] == run.result.last.parameters["k"][0]


def source_of_rows():
    from livepde.streams.sources import Rows

    return Rows(rows(5))


def test_a_broker_that_is_not_there_is_one_sentence():
    with pytest.raises(lp.DataError, match="no broker at 127"):
        MqttSource(Broker("127.0.0.1", 1), {"x": None}, "t")
