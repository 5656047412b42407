"""What is shown while a run works."""

import math
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

_RATE_WINDOW = 20
"""Reports over which the speed shown is averaged."""


class ProgressDisplay:
    """A progress bar on a terminal; elsewhere plain lines, one every `interval` seconds.

        with ProgressDisplay("stage 2", total=100_000) as progress:
            progress.update(step, {"return": 0.4, "success": 0.5, "loss/td": 0.01})
    """

    def __init__(self, label: str, total: int, *, start: int = 0, unit: str = "steps", interval: float = 10.0,
                 console: Console | None = None) -> None:
        """Args:
            label: what is being done.
            total: where `update` will end.
            start: where it begins, when a run is resumed.
            unit: what is counted.
            interval: seconds between plain lines.
            console: where to show it; standard output by default.
        """
        self._label, self._total, self._unit, self._interval = label, total, unit, interval
        self._console = console or Console(file=sys.stdout, highlight=False)
        self._reports: deque[tuple[float, int]] = deque([(time.monotonic(), start)], maxlen=_RATE_WINDOW)
        self._last_line = -math.inf
        self._bar: Progress | None = None
        if self._console.is_terminal:
            self._bar = _TwoLines(console=self._console)
            self._task = self._bar.add_task(label, total=total, completed=start, speed=self._speed(start), numbers="")

    def __enter__(self) -> "ProgressDisplay":
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, done: int, values: Mapping[str, float] | None = None) -> None:
        """Report that `done` units are done in all, with the latest numbers by name."""
        now = time.monotonic()
        self._reports.append((now, done))
        speed = self._speed(done)
        numbers = "  ".join(f"{name} {value:.3g}" for name, value in (values or {}).items() if value is not None)
        if self._bar is not None:
            self._bar.update(self._task, completed=done, speed=speed, numbers=numbers)
        elif now - self._last_line >= self._interval or done >= self._total:
            self._last_line = now
            self._console.print(f"{self._label}  {speed}  {numbers}".rstrip(), soft_wrap=True, markup=False)

    def print(self, line: str) -> None:
        """Show a line of its own, above the bar."""
        self._console.print(line, soft_wrap=True, markup=False)

    def _speed(self, done: int) -> str:
        (first_time, first_done), (last_time, last_done) = self._reports[0], self._reports[-1]
        rate = (last_done - first_done) / (last_time - first_time) if last_time > first_time else 0.0
        parts = [f"{done:,}/{self._total:,} {self._unit}", f"{100 * done / max(self._total, 1):.0f}%"]
        if rate > 0:
            shown = f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"
            parts += [f"{shown} {self._unit}/s", f"{_clock((self._total - done) / rate)} left"]
        return "  ".join(parts)


class _TwoLines(Progress):
    """The bar with its speed, and under it the numbers: both fit a terminal of 80 columns, a longer line is cut."""

    def __init__(self, console: Console) -> None:
        super().__init__(TextColumn("{task.description}"), BarColumn(bar_width=12), TextColumn("{task.fields[speed]}"),
                         console=console)

    def get_renderables(self) -> Iterator[RenderableType]:
        yield self.make_tasks_table(self.tasks)
        for task in self.tasks:
            yield Text(task.fields["numbers"], style="cyan", no_wrap=True, overflow="ellipsis")


def _clock(seconds: float) -> str:
    minutes, second = divmod(max(round(seconds), 0), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}" if hours else f"{minute:02d}:{second:02d}"
