"""Strangers at a broker: ``broker_strangers.py PORT TOPIC LARGEST RATE SECONDS``.

A program of its own, so that its work is no part of what it attacks. It publishes forged, altered,
repeated, retained, oversized and empty messages to a topic, RATE a second in all (0: as fast as
the broker takes them), and speaks broken MQTT to the broker itself. It prints how many messages of
each kind it has published, as JSON.
"""

import contextlib
import itertools
import json
import os
import socket
import sys
import threading
import time
from collections import Counter

import paho.mqtt.client as paho

#: Bytes that an envelope adds to a message; longer ones are refused by their length.
OVERHEAD = 65
#: What is no MQTT: noise, a length that never ends, a packet before CONNECT, a name of nobody.
BROKEN = (
    bytes(range(256)) * 20,
    b"\x10\xff\xff\xff\xff\xff",
    b"\x30\x05\x00\x03a/b",
    b"\x10\x0c\x00\x04MQTT\x09\x02\x00\x3c\x00\x00",
    b"GET / HTTP/1.1\r\nHost: broker\r\n\r\n",
)


def speak_broken(port: int, until: float) -> int:
    """Speak broken MQTT over a connection at a time, 20 a second; return their number."""
    for number in itertools.count():
        if time.monotonic() >= until:
            return number
        with (
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", port), timeout=1.0) as line,
        ):
            line.sendall(BROKEN[number % len(BROKEN)])
        time.sleep(0.05)
    return 0


def publish(port: int, topic: str, largest: int, rate: float, until: float) -> Counter[str]:
    """Publish until a time; return how often each kind."""
    seen, count = list[bytes](), Counter[str]()
    client = paho.Client(paho.CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
    client.on_message = lambda _, __, message: seen.append(message.payload)
    client.max_queued_messages_set(2000)
    client.connect("127.0.0.1", port)
    client.subscribe(topic)
    client.loop_start()
    kinds = ("forged", "altered", "repeated", "retained", "oversized", "empty")
    for kind in itertools.cycle(kinds):
        if time.monotonic() >= until:
            break
        heard = [data for data in seen[-50:] if len(data) > OVERHEAD] or [os.urandom(200)]
        one = heard[len(seen) % len(heard)]
        data = {
            "forged": os.urandom(OVERHEAD + len(seen) % 500),
            "altered": one[:-1] + bytes([one[-1] ^ 1]),
            "repeated": one,
            "retained": one,
            "oversized": bytes(largest + OVERHEAD + 1),
            "empty": b"",
        }[kind]
        if kind == "oversized" and count["oversized"] > 0.1 * count["forged"]:
            continue  # they are large enough
        client.publish(topic, data, qos=0, retain=kind == "retained")
        count[kind] += 1
        if len(seen) > 1000:
            del seen[:900]
        if rate:
            time.sleep(1.0 / rate)
        elif client._out_packet and len(client._out_packet) > 500:
            time.sleep(0.001)
    client.loop_stop()
    client.disconnect()
    return count


def main() -> None:
    """Attack."""
    port, largest = int(sys.argv[1]), int(sys.argv[3])
    rate, until = float(sys.argv[4]), time.monotonic() + float(sys.argv[5])
    broken = threading.Thread(target=speak_broken, args=(port, until))
    broken.start()
    count = publish(port, sys.argv[2], largest, rate, until)
    broken.join()
    print(json.dumps(count))


if __name__ == "__main__":
    main()
