"""The Markdown and JSON of `benchmarks/network.py`: tables, ratios, and whether its targets are met."""

import math
import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import torch
from runners import BATCH, DRAFT, NETWORKS, PAPER_BATCH, Runner
from speed_tables import asked, rate, shown

MEBIBYTE = 1 << 20
CROPS = "crops"


@dataclass(frozen=True)
class Key:
    """Identifies a timed job. points: n, or "crops"; people: number of people per call."""

    section: str
    network: str
    points: int | str
    people: int


# seconds of calls, in total and of the network alone
Times = dict[Key, list[tuple[float, float]]]


class Report:
    """Creates the Markdown report from times and memory."""

    def __init__(self, options, made: list[Runner], times: Times, memory_rows: list[dict], left_out: list[str]):
        self.options, self.made, self.times = options, made, times
        self.memory_rows, self.left_out = memory_rows, left_out
        self.names = [runner.name for runner in made]
        self.trained = [runner.name for runner in made if runner.trains]

    def seconds(self, section: str, network: str, points, people: int | None = None) -> tuple[np.ndarray, int] | None:
        """Seconds in total and of the network alone (calls, 2), and the people per call; None if not measured."""
        for key, values in self.times.items():
            if (key.section, key.network, key.points) == (section, network, points) and people in (None, key.people):
                return np.array(values), key.people
        return None

    def median(self, section: str, network: str, points, people: int | None = None, *, alone: bool = False) -> float:
        """Median seconds per person, NaN if not measured."""
        measurement = self.seconds(section, network, points, people)
        return math.nan if measurement is None else float(np.median(measurement[0][:, int(alone)])) / measurement[1]

    def best(self, section: str, network: str, points, people: int | None = None, *, alone: bool = False) -> float:
        """Minimum seconds per person, NaN if not measured."""
        measurement = self.seconds(section, network, points, people)
        return math.nan if measurement is None else float(measurement[0][:, int(alone)].min()) / measurement[1]

    def write(self) -> str:
        parts = [f"# Speed and memory of the network\n\n{self._machine()}"]
        if "latency" in self.options.sections:
            note = "Best / median. A row's network alone: without making its tables; of ONNX Runtime the session's run."
            parts.append(f"## Latency of one person, ms\n\n{note}\n\n{self._latency()}")
        columns = (*self.options.points, CROPS)
        if "forward" in self.options.sections:
            note = f"Best / median, tables made on the way. Batches of {BATCH}, `paper` of {self._paper_batch()}."
            names = [name for name in self.names if self.seconds("forward", name, columns[0])]
            parts.append(f"## Forward, people a second\n\n{note}\n\n{self._rates('forward', names, columns)}")
            parts.append(
                "### The network alone, its tables made before\n\n"
                + self._rates("forward", [n for n in names if "ONNX" not in n], columns, alone=True)
            )
        if "training" in self.options.sections:
            precision = "float32" if self.options.device == "cpu" else "bfloat16"
            note = f"Best / median, {precision}. Batches of {BATCH}, `paper` of {self._paper_batch()}."
            parts.append(f"## Training, people a second\n\n{note}\n\n{self._rates('training', self.trained, columns)}")
        parts.append(f"## Ratios of speed, of medians\n\n{self._ratios()}")
        if "scaling" in self.options.sections:
            parts.append(f"## `tiny`: people a second by batch and points, median\n\n{self._scaling()}")
        if self.memory_rows:
            parts.append(f"## Peak memory of training steps, MiB\n\n{self._memory()}")
        parts.append(f"## Targets\n\n{table(*asked(self.targets()))}")
        if self.left_out:
            parts.append("## Left out\n\n" + "\n".join(f"- {line}" for line in self.left_out))
        return "\n\n".join(parts) + "\n"

    def _machine(self) -> str:
        load = " ".join(f"{value:.1f}" for value in os.getloadavg())
        device = self.options.device
        if device != "cpu":
            device = torch.cuda.get_device_name()
        return (
            f"{processor()}, {os.cpu_count()} cores, {self.options.threads} threads; device {device}; "
            f"torch {torch.__version__}, ONNX Runtime {_version('onnxruntime')}, Python {platform.python_version()}; "
            f"{self.options.rounds} rounds; load at the end {load}."
        )

    def _paper_batch(self) -> int:
        return next((runner.batch for runner in self.made if runner.name == "paper"), PAPER_BATCH)

    def _latency(self) -> str:
        rows = []
        parameters = {runner.name: runner.parameters for runner in self.made}
        for name in self.names:
            if not name.endswith("session"):
                cells = [self._cell("latency", name, n) for n in self.options.points]
                rows.append([name, f"{parameters[name]:,}", *cells])
            if "predict()" not in name and not name.endswith("ONNX"):
                cells = [self._cell("latency", name, n, alone=True) for n in self.options.points]
                rows.append([name if name.endswith("session") else f"{name}, network alone", "", *cells])
        return table(["network", "parameters", *map(shown, self.options.points)], rows)

    def _cell(self, section: str, name: str, points, *, alone: bool = False) -> str:
        best, median = (f(section, name, points, alone=alone) * 1e3 for f in (self.best, self.median))
        return "-" if math.isnan(median) else f"{best:.2f} / {median:.2f}"

    def _rates(self, section: str, names: list[str], columns, *, alone: bool = False) -> str:
        rows = []
        for name in names:
            pairs = [[f(section, name, n, alone=alone) for f in (self.best, self.median)] for n in columns]
            rows.append([name, *("-" if math.isnan(b) else f"{rate(a)} / {rate(b)}" for a, b in pairs)])
        return table(["network", *map(shown, columns)], rows)

    def _ratios(self) -> str:
        draft_by_size = {"tiny": f"{DRAFT} as tiny", "small": DRAFT}
        pairs = []
        for size, draft in draft_by_size.items():
            pairs += [(size, other) for other in (draft, f"ViT as {size}", f"PointNet++ as {size}")]
        pairs += [(f"{size} ONNX", size) for size in NETWORKS[:3]] + [("tiny", "small"), ("small", "base")]
        pairs += [("tiny", "paper")]
        columns = (*self.options.points, CROPS)
        rows = []
        for network, other in pairs:
            for section in ("latency", "forward", "training"):
                values = [self.median(section, other, n) / self.median(section, network, n) for n in columns]
                if not all(map(math.isnan, values)):
                    cells = ["-" if math.isnan(value) else f"{value:.2f}" for value in values]
                    rows.append([f"{network} over {other}", section, *cells])
        return table(["pair", "", *map(shown, columns)], rows)

    def _scaling(self) -> str:
        all_rows = []
        for section in ("scaling forward", "scaling training"):
            rows = []
            for n in self.options.scaling_points:
                medians = [self.median(section, "tiny", n, people) for people in self.options.scaling_people]
                rows.append([f"{section.split()[1]}, {shown(n)}", *("-" if m != m else rate(m) for m in medians)])
            all_rows += rows
        note = "A person of more than so many voxels is thinned, so cost stops growing where that begins."
        head = ["points", *(f"batch {people}" for people in self.options.scaling_people)]
        return f"{table(head, all_rows)}\n\n{note}"

    def _memory(self) -> str:
        rows = []
        for row in self.memory_rows:
            before, peak = row["before"] / MEBIBYTE, row["peak"] / MEBIBYTE
            cells = [row["network"], shown(row["points"]), str(row["people"]), f"{before:,.0f}", f"{peak:,.0f}"]
            cells.append(f"{peak - before:,.0f}")
            if "device_peak" in row:
                cells.append(f"{row['device_peak'] / MEBIBYTE:,.0f}")
            rows.append(cells)
        head = ["network", "points", "people", "after imports", "peak", "of the step"]
        return table(head + ["on the device"] * any("device_peak" in row for row in self.memory_rows), rows)

    def targets(self) -> list[dict]:
        """A dict for each target: what, unit, target, whether it is a maximum; figures from the medians and from the
        best rounds, None if not measured; whether the medians meet the target."""
        by_median, by_best = self._figures(self.median), self._figures(self.best)
        rows = []
        for (what, unit, most, target, figure), (*_, best) in zip(by_median, by_best, strict=True):
            is_met = None if math.isnan(figure) else bool(figure <= target if most else figure >= target)
            figure, best = (None if math.isnan(value) else value for value in (figure, best))
            rows.append(dict(what=what, unit=unit, most=most, target=target, figure=figure, best=best, met=is_met))
        return rows

    def _figures(self, statistic: Callable[..., float]) -> list[tuple[str, str, bool, float, float]]:
        """what, unit, whether the target is a maximum, target, figure; statistic: `median` or `best`."""
        figures = [
            ("`tiny` ONNX, one person of 512 points", "ms", True, 3, statistic("latency", "tiny ONNX", 512) * 1e3),
            ("`tiny` in torch, one person of 512 points", "ms", True, 8, statistic("latency", "tiny", 512) * 1e3),
            ("`tiny` training, crops", "people/s", False, 500, 1 / statistic("training", "tiny", CROPS)),
        ]
        for n in (256, 512):
            ratio = statistic("training", DRAFT, n) / statistic("training", "small", n)
            figures.append((f"`small` over the draft, training, {n} points", "x", False, 1.5, ratio))
        figures.append(("`paper` forward, 512 points", "people/s", False, 10, 1 / statistic("forward", "paper", 512)))
        low, high = self.options.scaling_people[-2:]
        for kind in ("forward", "training"):
            small_cost, large_cost = (statistic(f"scaling {kind}", "tiny", 512, people) for people in (low, high))
            figures.append(
                (
                    f"`tiny` {kind}, cost a person, batch {high} over batch {low}",
                    "x",
                    True,
                    1.15,
                    large_cost / small_cost,
                )
            )
            small_cost, large_cost = (statistic(f"scaling {kind}", "tiny", n, BATCH) for n in (128, 512))
            exponent = math.log(large_cost / small_cost) / math.log(4)
            figures.append((f"`tiny` {kind}, exponent of cost, 128 to 512 points", "", True, 1.2, exponent))
        peaks = [row["peak"] / 1e9 for row in self.memory_rows if row["network"] == "tiny"]
        figures.append(("`tiny` training, peak memory", "GB", True, 2, max(peaks, default=math.nan)))
        return figures

    def to_json(self) -> dict:
        options = {name: value for name, value in vars(self.options).items() if name != "json"}
        return {
            "machine": self._machine(),
            "options": options,
            "parameters": {runner.name: runner.parameters for runner in self.made},
            "times": [
                vars(key) | {"median_s": self.median(**vars(key)), "best_s": self.best(**vars(key))}
                for key in self.times
            ],
            "memory": self.memory_rows,
            "targets": self.targets(),
            "left_out": self.left_out,
        }


def table(head: Sequence[str], rows: list[Sequence[str]]) -> str:
    lines = [head, ["---"] + ["---:"] * (len(head) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
