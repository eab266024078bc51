"""How well a first look at a recording finds an offset that is put between the clocks of its views and its odometry.

    python tools/clock_study.py SOURCE... [--set KEY=VALUE] [--put -0.2 -0.1 0 0.1 0.2] [--end 62]

For each source and each value the odometry is stamped that much earlier, and the offset is estimated from the first metres. The
error is against the estimate without a shift plus the value put in, so the recording's own offset need not be known.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

from hybridmap.calibration.clock import ClockOffset
from hybridmap.cli.choose import choose, parse_settings
from hybridmap.session import first_look
from hybridmap.streams.base import Motion, Sample, Stream
from hybridmap.streams.order import ReorderBuffer
from hybridmap.trajectory import NS_PER_S


class Shifted:
    """A stream whose odometry is stamped earlier."""

    def __init__(self, stream: Stream, early_s: float) -> None:
        self._stream, self._early_s = stream, early_s
        self.name, self.rig, self.groundtruth = stream.name, stream.rig, stream.groundtruth
        self.expected_observations, self.report = stream.expected_observations, stream.report

    def __iter__(self) -> Iterator[Sample]:
        """Yield the samples in order of their new stamps."""
        late, early_ns = ReorderBuffer(abs(self._early_s)), round(self._early_s * NS_PER_S)
        for sample in self._stream:
            if isinstance(sample, Motion):
                sample = replace(sample, stamp_ns=sample.stamp_ns - early_ns)
            yield from late.push(sample)
        yield from late.flush()


def looked(source: str, settings: list[str], put_s: float, end_s: float | None) -> ClockOffset:
    """What a first look finds with an offset put in."""
    opened = choose(source, None, parse_settings(settings), end_s=end_s)
    return first_look(Shifted(opened.stream, put_s), opened.config)


def main() -> None:
    """Print a line for each source and value."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", metavar="SOURCE")
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="KEY=VALUE")
    parser.add_argument("--put", nargs="+", type=float, default=[-0.2, -0.1, 0.0, 0.1, 0.2], metavar="S")
    parser.add_argument("--end", type=float, default=None, metavar="S")
    given = parser.parse_args()
    for source in given.sources:
        own = looked(source, given.settings, 0.0, given.end)
        for put_s in given.put:
            found = looked(source, given.settings, put_s, given.end) if put_s else own
            error_ms = 1e3 * (found.offset_s - own.offset_s - put_s)
            said = f"{1e3 * found.offset_s:7.1f} +- {1e3 * found.sigma_s:4.1f} ms, off by {error_ms:5.1f} ms"
            print(f"{source}  put in {1e3 * put_s:6.0f} ms: {said}  ({found.state}, {found.travel_m:.0f} m)", flush=True)


if __name__ == "__main__":
    main()
