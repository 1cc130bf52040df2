"""Delays, loses and reorders the packets that this network namespace sends, until SIGTERM.

By `tc netem` where the kernel has it; else the kernel queues packets to this process (NFQUEUE), which lets each go
after a time of its own. The last line says how many packets were sent and lost.
"""

import argparse
import heapq
import random
import select
import signal
import socket
import struct
import subprocess
import sys
import time

NETFILTER = 12
QUEUE_SUBSYSTEM = 3 << 8
PACKET, VERDICT, CONFIG = (QUEUE_SUBSYSTEM | kind for kind in (0, 1, 2))
ERROR = 2
REQUEST, ACKNOWLEDGE = 1, 4
DROP, ACCEPT = 0, 1


def interface() -> str:
    """Name of the interface of the default route: another one each time that a container joined its network anew."""
    with open("/proc/net/route") as routes:
        return next(fields[0] for fields in map(str.split, routes) if fields[1] == "00000000")


class Queue:
    """Queue 0 of the kernel's, of packets' numbers without their content."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, NETFILTER)
        self.socket.bind((0, 0))
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        # Bind; copy packets' headers only; room for many of them.
        self._ask(CONFIG, 1, struct.pack(">BxH", 1, socket.AF_INET))
        self._ask(CONFIG, 2, struct.pack(">IB", 0, 1))
        self._ask(CONFIG, 3, struct.pack(">I", 1 << 16))

    def _send(self, kind: int, flags: int, attribute: int, value: bytes) -> None:
        body = struct.pack(">BBH", socket.AF_UNSPEC, 0, 0)
        body += struct.pack("=HH", 4 + len(value), attribute) + value + bytes(-len(value) % 4)
        self.socket.send(struct.pack("=IHHII", 16 + len(body), kind, flags, 0, 0) + body)

    def _ask(self, kind: int, attribute: int, value: bytes) -> None:
        self._send(kind, REQUEST | ACKNOWLEDGE, attribute, value)
        answer = self.socket.recv(1 << 16)
        (code,) = struct.unpack_from("=i", answer, 16)
        if code:
            raise OSError(-code, "configuring the queue of packets")

    def packets(self) -> list[int]:
        """Numbers of packets that came in."""
        try:
            data = self.socket.recv(1 << 16)
        except OSError:  # Too many at once: those are lost, as on a network.
            return []
        numbers, start = [], 0
        while start + 16 <= len(data):
            length, kind = struct.unpack_from("=IH", data, start)
            at, end = start + 20, start + length
            while kind == PACKET and at + 4 <= end:
                size, attribute = struct.unpack_from("=HH", data, at)
                if attribute & 0x3FFF == 1:
                    numbers.append(struct.unpack_from(">I", data, at + 4)[0])
                at += (size + 3) & ~3
            start += (length + 3) & ~3
        return numbers

    def judge(self, number: int, verdict: int) -> None:
        """Lets a packet go, or not."""
        self._send(VERDICT, REQUEST, 2, struct.pack(">II", verdict, number))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--delay-ms", type=float, default=50)
    parser.add_argument("--jitter-ms", type=float, default=10)
    parser.add_argument("--loss-percent", type=float, default=1)
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())

    device = interface()
    delay = ["delay", f"{options.delay_ms}ms", f"{options.jitter_ms}ms", "loss", f"{options.loss_percent}%"]
    netem = subprocess.run(
        ["tc", "qdisc", "add", "dev", device, "root", "netem", *delay], capture_output=True, text=True, check=False
    )
    if netem.returncode == 0:
        print("impaired by netem")
        try:
            signal.pause()
        finally:
            print(subprocess.run(["tc", "-s", "qdisc", "show", "dev", device], capture_output=True, text=True).stdout)
            subprocess.run(["tc", "qdisc", "del", "dev", device, "root"], check=True)
        return

    print(f"no netem: {netem.stderr.strip()}")
    queue = Queue()
    rule = ["OUTPUT", "-o", device, "-j", "NFQUEUE", "--queue-num", "0", "--queue-bypass"]
    subprocess.run(["iptables", "-A", *rule], check=True)
    print("impaired by a queue of packets")
    sent = lost = reordered = 0
    waiting: list[tuple[float, int]] = []
    last = 0
    try:
        while True:
            pause = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
            readable, _, _ = select.select([queue.socket], [], [], pause)
            if readable:
                for number in queue.packets():
                    if random.uniform(0, 100) < options.loss_percent:
                        lost += 1
                        queue.judge(number, DROP)
                    else:
                        jitter = random.uniform(-options.jitter_ms, options.jitter_ms)
                        heapq.heappush(waiting, (time.monotonic() + (options.delay_ms + jitter) / 1000, number))
            while waiting and waiting[0][0] <= time.monotonic():
                _, number = heapq.heappop(waiting)
                sent, reordered, last = sent + 1, reordered + (number < last), number
                queue.judge(number, ACCEPT)
    finally:
        subprocess.run(["iptables", "-D", *rule], check=True)
        for _, number in waiting:
            queue.judge(number, ACCEPT)
        print(f"sent {sent}, lost {lost}, reordered {reordered}")


if __name__ == "__main__":
    main()
