"""Runs with a real broker: rows are acknowledged once stored, and sent again after a crash."""

import gc
import json
import logging
import queue
import subprocess
import sys
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
from broker import MOSQUITTO, Server
from certificates import certificate
from live_rod import COLUMNS, live, rows, same
from patience import PATIENCE

import livepde as lp
from livepde.runs.feeds import Gathered
from livepde.streams.clock import Clock
from livepde.streams.intake import Intake, Policy
from livepde.streams.mqtt import Broker, MqttSink, MqttSource, _check_overlap, home_assistant
from livepde.streams.sources import Rows

pytest.importorskip("paho.mqtt")
pytestmark = [
    pytest.mark.broker,
    pytest.mark.skipif(MOSQUITTO is None, reason="needs the broker mosquitto"),
]


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    monkeypatch.setattr("livepde.streams.mqtt.PATIENCE", 60.0)


def source(server: Server, topics=None, **options) -> MqttSource:
    broker = Broker("127.0.0.1", server.port, **options)
    return MqttSource(broker, topics or {"rod": None}, "t")


def listen(source, count: int) -> list:
    """Poll until at least `count` rows have arrived, and return all rows."""
    found = []
    until = time.monotonic() + PATIENCE
    while len(found) < count and time.monotonic() < until:
        found += source.poll(0.2)
    assert len(found) >= count
    return found


def subscribed(source: MqttSource) -> queue.Queue[int]:
    """Return a queue that collects the numbers of answered subscriptions."""
    answered: queue.Queue[int] = queue.Queue()
    source._client.on_subscribe = lambda client, _, number, *__: answered.put(number)
    return answered


def acknowledge(source: MqttSource, found: list) -> None:
    """Acknowledge rows, and wait until the broker has received it."""
    source.acknowledge([row.token for row in found])
    answered = subscribed(source)  # the broker answers in order
    _, number = source._client.subscribe("nothing")
    while answered.get(timeout=PATIENCE) != number:
        pass


def polled(source) -> None:
    """Poll until an exception is raised."""
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:
        source.poll(0.2)


def publish(server: Server, messages, topic: str = "rod") -> None:
    client = Broker("127.0.0.1", server.port).client("-plant")
    Broker("127.0.0.1", server.port, "plant").connect(client)
    for message in messages:
        text = message if isinstance(message, str) else json.dumps(message)
        client.publish(topic, text, qos=1).wait_for_publish(PATIENCE)
    client.disconnect()
    client.loop_stop()


def until(run, count: int) -> None:
    """Run until sinks got `count` samples; one more may be processed if it is available."""

    class Counter:
        def put(self, estimate):
            if len(run.result) >= count:
                run.stopping.set()

        def close(self):
            pass

    run.sinks = [*run.sinks, Counter()]
    run.stopping.clear()
    alarm = threading.Timer(PATIENCE, run.stopping.set)
    alarm.start()
    try:
        run.run()
    finally:
        alarm.cancel()


def test_unacknowledged_rows_are_sent_again(server, tmp_path):
    first = source(server)
    publish(server, [*list(rows(30)), "{", '{"t": "x"}'])
    run = live(tmp_path, first)
    until(run, 12)
    first.close()  # the other messages were received, but not acknowledged
    run.journal.close()
    server.stop()
    server.start()
    publish(server, list(rows(40))[30:])
    again = live(tmp_path, source(server))
    again.resume()
    until(again, 40)
    assert [round(record.t, 6) for record in again.journal] == [
        round(0.1 * k, 6) for k in range(40)
    ]
    again.feed.close()


def test_numbers_may_have_separate_topics(server):
    heard = source(server, {"plant/a": "a", "plant/+/level": "b"})
    publish(server, ["1.5", '{"value": 2.5, "t": 7}', "warm"], "plant/a")
    publish(server, ["3"], "plant/x/level")
    found = listen(heard, 4)
    heard.close()
    assert found[0].values["a"] == 1.5
    assert found[1].values == {"t": 7, "a": 2.5}
    assert "not a number" in found[2].broken
    assert found[3].values["b"] == 3


def estimates(tmp_path, count: int) -> list:
    """Return `count` estimates of a run."""

    class Kept(list):
        put = list.append

        def close(self):
            pass

    kept = Kept()
    run = live(tmp_path, Rows(rows(count)), sinks=[kept])
    run.run()
    run.journal.close()
    return kept


def sink(server: Server, **options) -> MqttSink:
    return MqttSink(Broker("127.0.0.1", server.port, "sink"), "rod/out", **options)


def test_estimates_are_published(server, tmp_path):
    found = estimates(tmp_path, 5)
    heard = source(server, {"rod/out": None, "rod/out/unknowns/+": "k", "rod/out/status": "on"})
    publisher = sink(server)
    for estimate in found:
        publisher.put(estimate)
    publisher.close()
    came = [row.values for row in listen(heard, 12) if not row.broken]
    heard.close()
    objects = [row for row in came if "innovation" in row]
    assert [row["t"] for row in objects] == pytest.approx([0.1 * k for k in range(5)])
    k = found[-1].parameters["k"]
    assert objects[-1]["unknowns"] == {"k": {"value": k[0], "std": k[1]}}
    assert [row["k"] for row in came if "k" in row][-1] == k[0]


def retained(server: Server, topics: str, count: int) -> dict:
    """Return the retained messages of topics."""
    told: queue.Queue = queue.Queue()
    broker = Broker("127.0.0.1", server.port, "assistant")
    client = broker.client()
    client.on_connect = lambda client, *_: client.subscribe(topics)
    client.on_message = lambda client, _, message: told.put(message)
    broker.connect(client)
    messages = [told.get(timeout=PATIENCE) for _ in range(count)]
    client.disconnect()
    client.loop_stop()
    assert told.empty()
    assert all(message.retain for message in messages)
    return {message.topic: json.loads(message.payload) for message in messages}


def test_home_assistant_finds_the_numbers_of_a_run(server, tmp_path):
    found = estimates(tmp_path, 3)
    publisher = sink(server, discovery=True, title="The rod")
    for estimate in found:
        publisher.put(estimate)
    publisher.close()
    told = retained(server, "homeassistant/#", 2)
    k = told["homeassistant/sensor/rod_out_k/config"]
    assert k["name"] == "k"
    assert k["device"]["name"] == "The rod"
    assert "unit_of_measurement" not in k  # the unknown has no unit
    verdict = told["homeassistant/sensor/rod_out_verdict/config"]
    assert verdict["device"] == k["device"]
    assert verdict["state_topic"] == "rod/out"
    assert verdict["unique_id"] != k["unique_id"]
    # The named topics contain the numbers that the templates read.
    value = retained(server, k["state_topic"], 1)[k["state_topic"]]["value"]
    assert k["value_template"] == "{{ value_json.value }}"
    assert value == found[-1].parameters["k"][0]
    assert "verdict" in found[-1].to_dict()
    assert (k["availability_topic"], k["payload_available"]) == ("rod/out/status", "running")


def test_units_and_names_that_are_invalid_in_topics_are_replaced():
    unit = SimpleNamespace(unit="W/(m K)")
    space = SimpleNamespace(unknown_of=lambda label: unit)
    estimate = SimpleNamespace(space=space, parameters={"k #1/2": (1.0, 0.1)})
    (topic, k), _ = home_assistant(estimate, "a/b", "A")
    assert topic == "homeassistant/sensor/a_b_k__1_2/config"
    assert k["unit_of_measurement"] == "W/(m K)"
    assert k["state_topic"] == "a/b/unknowns/k _1_2"


def test_estimates_wait_for_the_broker_and_the_oldest_are_dropped(server, tmp_path, caplog):
    found = estimates(tmp_path, 60)
    heard = source(server, {"rod/out": None})
    publisher = sink(server, keep=5)
    server.stop()
    for estimate in found:
        publisher.put(estimate)
    assert publisher.dropped >= 30
    assert caplog.text.count("old estimates are not sent") == 1
    server.start()
    came = listen(heard, 60 - publisher.dropped)
    publisher.close()
    heard.close()
    times = [row.values["t"] for row in came]
    assert times == sorted(set(times))
    assert times[-5:] == [estimate.t for estimate in found[-5:]]


def test_a_sink_can_be_closed_while_the_broker_is_away(server, tmp_path, caplog, monkeypatch):
    publisher = sink(server)
    monkeypatch.setattr("livepde.streams.mqtt.PATIENCE", 0.5)
    server.stop()
    for estimate in estimates(tmp_path, 40):
        publisher.put(estimate)
    publisher.close()
    assert "did not accept all estimates" in caplog.text
    assert not publisher._sender.is_alive()
    server.start()


CHILD = """
import sys
from livepde.streams.mqtt import Broker, MqttSink
MqttSink(Broker("127.0.0.1", int(sys.argv[1]), "sink"), "rod/out")
print("ready", flush=True)
sys.stdin.read()
"""


def test_the_status_topic_shows_whether_the_run_is_online(server):
    told: queue.Queue[str] = queue.Queue()
    broker = Broker("127.0.0.1", server.port, "watchdog")
    watchdog = broker.client()
    watchdog.on_connect = lambda client, *_: client.subscribe("rod/out/status")
    watchdog.on_message = lambda client, _, message: told.put(message.payload.decode())
    broker.connect(watchdog)
    publisher = sink(server)
    assert told.get(timeout=PATIENCE) == "running"
    publisher.close()
    assert told.get(timeout=PATIENCE) == "offline"
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(server.port)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    with child:
        assert child.stdout.readline() == b"ready\n"
        assert told.get(timeout=PATIENCE) == "running"
        child.kill()
        assert told.get(timeout=PATIENCE) == "offline"
    watchdog.disconnect()
    watchdog.loop_stop()


def test_a_broker_restart_does_not_change_the_rows(server):
    heard = source(server)
    publish(server, [{"t": k} for k in range(30)])
    came = listen(heard, 30)
    heard.acknowledge([row.token for row in came[:5]])
    server.stop()
    heard.acknowledge([row.token for row in came[5:10]])  # sent when the broker is back
    server.start()
    publish(server, [{"t": 30}])
    came += listen(heard, 1)
    assert [row.values["t"] for row in came] == list(range(31))
    acknowledge(heard, came[10:20])
    heard.close()
    again = source(server)
    assert [row.values["t"] for row in listen(again, 11)] == list(range(20, 31))
    again.close()


def test_an_acknowledgement_never_confirms_another_message(server):
    heard = source(server)
    publish(server, [{"t": 0}, {"t": 1}])
    old = listen(heard, 2)
    server.stop()
    (server.folder / "mosquitto.db").unlink()  # the broker loses sessions and restarts its numbers
    answered = subscribed(heard)
    server.start()
    answered.get(timeout=PATIENCE)
    publish(server, [{"t": 2}, {"t": 3}])
    new = listen(heard, 2)
    assert [row.token.number for row in new] == [row.token.number for row in old]
    acknowledge(heard, old)
    heard.close()
    again = source(server)
    assert [row.values["t"] for row in listen(again, 2)] == [2, 3]
    again.close()


def test_a_backlog_larger_than_the_receive_window_arrives(server, tmp_path, monkeypatch):
    messages = list(rows(60))
    heard = source(server, ahead=5)
    publish(server, messages)
    run = live(tmp_path, heard)  # samples wait for steps, so the broker also waits
    until(run, 60)
    assert len(run.journal) == 60
    assert not run.journal.counts
    monkeypatch.setattr("livepde.streams.mqtt.PATIENCE", 2.0)
    stuck = Gathered(heard, Intake(COLUMNS, Clock("t"), Policy(wait=1e6), origin=0.0))
    publish(server, messages)
    with pytest.raises(lp.errors.DataError, match="messages wait for later ones"):
        polled(stuck)
    heard.close()


def test_unacknowledged_rows_are_never_used_twice(server, tmp_path, monkeypatch):
    heard = source(server)
    publish(server, rows(20))
    run = live(tmp_path, heard)
    monkeypatch.setattr(heard, "acknowledge", lambda tokens: None)  # as if killed before
    until(run, 12)
    taken = run.journal.accepted
    assert taken in (12, 13)
    heard.close()
    run.journal.close()
    again = live(tmp_path, source(server))
    again.resume()
    until(again, 20)
    assert [round(record.t, 6) for record in again.journal] == [
        round(0.1 * k, 6) for k in range(20)
    ]
    assert again.journal.counts == {("repeated", ""): taken}
    again.feed.close()
    again.journal.close()


def test_a_block_that_a_gateway_sends_again_changes_nothing(server, tmp_path):
    """The broker sees new messages, but also a resumed run recognises the repeated rows."""
    given = list(rows(60))
    heard = source(server)
    publish(server, [*given[:40], *given[20:40], *given[40:50]])
    run = live(tmp_path, heard, verdict=False)
    until(run, 50)
    heard.close()
    run.journal.close()
    again = live(tmp_path, source(server), verdict=False)
    again.resume()
    publish(server, [*given[10:50], *given[50:]])
    until(again, 60)
    assert [record.t for record in again.journal] == [row["t"] for row in given]
    assert again.journal.counts == {("repeated", ""): 60}
    (tmp_path / "alone").mkdir()
    alone = live(tmp_path / "alone", Rows(given), verdict=False)
    alone.run()
    same(again.journal, alone.journal)
    again.feed.close()
    again.journal.close()


def test_long_messages_are_refused_and_the_next_one_arrives(server):
    heard = source(server)
    publish(server, ["x" * 2_000_000, '{"t": 1}', "x" * 20_000_000, '{"t": 2}'])
    came = listen(heard, 3)
    heard.close()
    assert "longer than" in came[0].broken
    assert not came[0].values
    assert [row.values for row in came[1:]] == [{"t": 1}, {"t": 2}]


def test_topics_of_an_earlier_case_are_unsubscribed(server):
    source(server, {"old": None}).close()
    heard = source(server, {"rod": None})
    publish(server, [{"t": 1}], "old")
    publish(server, [{"t": 2}])
    (row,) = listen(heard, 1)
    assert row.values == {"t": 2}
    heard.close()


def test_two_runs_need_two_client_names(server, caplog):
    first = source(server)
    second = source(server)  # some brokers disconnect without a reason
    publish(server, [{"t": 1}])
    until = time.monotonic() + PATIENCE
    while "another client the same client_id" not in caplog.text and time.monotonic() < until:
        time.sleep(0.1)
    assert "another client the same client_id" in caplog.text
    second.close()
    from paho.mqtt.packettypes import PacketTypes
    from paho.mqtt.reasoncodes import ReasonCode

    reason = ReasonCode(PacketTypes.DISCONNECT, "Session taken over")
    first._client.on_disconnect(first._client, None, None, reason, None)  # others send one
    with pytest.raises(lp.errors.DataError, match="another client uses the session 'livepde'"):
        polled(first)
    first.close()


def test_a_broker_that_refuses_later_is_reported(server, caplog):
    caplog.set_level(logging.INFO, "livepde.mqtt")
    heard = source(server)
    server.stop()
    settings = server.config.read_text()
    server.config.write_text(settings.replace("allow_anonymous true", "allow_anonymous false"))
    server.start()
    until = time.monotonic() + PATIENCE
    while "refuses: Not authorized" not in caplog.text and time.monotonic() < until:
        time.sleep(0.1)
    assert "lost: " in caplog.text
    assert "refuses: Not authorized" in caplog.text
    with pytest.raises(lp.errors.DataError, match="Not authorized"):
        source(server, client_id="another")
    server.stop()
    server.config.write_text(settings)
    server.start()
    publish(server, [{"t": 1}])
    assert listen(heard, 1)
    assert "again" in caplog.text
    heard.close()


def test_topics_with_both_wildcards_and_numbers_of_unknown_age(server):
    retained = Broker("127.0.0.1", server.port, "retained")
    client = retained.client()
    retained.connect(client)
    client.publish("plant/x/a/b", "2.5", qos=1, retain=True).wait_for_publish(PATIENCE)
    client.publish("plant/y/a/b", '{"value": 3, "t": 5}', qos=1, retain=True).wait_for_publish(
        PATIENCE
    )
    client.disconnect()
    client.loop_stop()
    heard = source(server, {"plant/+/a/#": "a", "+/level": "b"})
    old = {row.broken: row.values for row in listen(heard, 2)}
    assert old == {"retained by the broker without a time": {}, "": {"t": 5, "a": 3}}
    publish(server, ["4"], "plant/z/a/c/d")
    publish(server, ["5"], "tank/level")
    values = [row.values for row in listen(heard, 2)]
    heard.close()
    assert values[0]["a"] == 4
    assert values[1]["b"] == 5
    assert all("T" in row["t"] for row in values)


@pytest.mark.parametrize(
    ("one", "other", "overlap"),
    [
        ("a/b", "a/b/c", False),
        ("a/+", "a/b", True),
        ("+/b", "a/+", True),
        ("a/#", "a", True),
        ("a/+/#", "a", False),
        ("x/#", "y/#", False),
    ],
)
def test_topics_that_bring_a_message_twice(one, other, overlap):
    if not overlap:
        _check_overlap(one, other)
        _check_overlap(other, one)
        return
    for topics in ({one: None, other: "a"}, {other: "a", one: None}):
        with pytest.raises(lp.errors.DataError, match="some messages twice"):
            MqttSource(Broker(), topics, "t")


# paho-mqtt leaves the socket of a failed handshake to the garbage collector.
@pytest.mark.filterwarnings("ignore:.*ssl.SSLSocket:pytest.PytestUnraisableExceptionWarning")
def test_a_connection_is_encrypted_with_a_custom_certificate(server, tmp_path):
    signed, key = certificate(server.folder, "localhost")
    server.stop()
    text = server.config.read_text()
    server.config.write_text(f"{text}certfile {signed}\nkeyfile {key}\n")
    server.start()
    broker = Broker("localhost", server.port, ca_file=str(signed))
    heard = MqttSource(broker, {"rod": None}, "t")
    client = replace(broker, client_id="plant").client()
    replace(broker, client_id="plant").connect(client)
    client.publish("rod", '{"t": 1}', qos=1).wait_for_publish(PATIENCE)
    assert listen(heard, 1)[0].values == {"t": 1}
    heard.close()
    client.disconnect()
    client.loop_stop()
    with pytest.raises(
        lp.errors.DataError, match="certificate verify failed"
    ):  # system certificates do not include it
        MqttSource(Broker("localhost", server.port, tls=True), {"rod": None}, "t")
    gc.collect()  # in this test, not in a later one


@pytest.mark.parametrize("topic", ["", "a/#/b", "a+/b", "a/b#"])
def test_invalid_topics_are_refused(topic):
    with pytest.raises(lp.errors.DataError, match="got the topic"):
        MqttSource(Broker(), {topic: None}, "t")


def test_invalid_settings_of_a_broker_are_refused(server, tmp_path):
    with pytest.raises(lp.errors.DataError, match=r"ca_file .*none.pem cannot be used"):
        source(server, ca_file=str(tmp_path / "none.pem"))
    with pytest.raises(lp.errors.DataError, match="topic 'a/\\+' to publish to"):
        MqttSink(Broker("127.0.0.1", server.port), "a/+")
    with pytest.raises(lp.errors.DataError, match="ahead must be"):
        Broker(ahead=70000)
    assert "secret" not in repr(Broker(username="u", password="secret"))


def test_a_missing_broker_is_reported_in_one_sentence():
    with pytest.raises(lp.errors.DataError, match="no broker at 127"):
        MqttSource(Broker("127.0.0.1", 1), {"x": None}, "t")
