"""Chart of throughput and latencies against the number of clients."""

from collections.abc import Sequence
from pathlib import Path

from cpn_bench import chart
from cpn_bench.plan.service import Measurement


def draw(measured: Sequence[Measurement], path: Path) -> None:
    """Draws throughput, median and 99th percentile of the latency, with a line for each transport."""
    figure = chart.figure()
    panels = figure.subplots(1, 3)
    quantities = ("plans_per_second", "p50_ms", "p99_ms")
    labels = ("plans/s", "latency, p50, ms", "latency, p99, ms")
    for panel, quantity, label in zip(panels, quantities, labels, strict=True):
        for transport in dict.fromkeys(m.transport for m in measured):
            of = sorted((m for m in measured if m.transport == transport), key=lambda m: m.clients)
            panel.plot([m.clients for m in of], [getattr(m, quantity) for m in of], marker="o", label=transport)
        clients = sorted({m.clients for m in measured})
        panel.set(xlabel="clients", ylabel=label, xscale="log", yscale="log")
        panel.set_xticks(clients, labels=map(str, clients))
        panel.minorticks_off()
        panel.grid(visible=True, which="both", alpha=0.3)
    panels[-1].legend()
    chart.save(figure, path)
