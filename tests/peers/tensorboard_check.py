"""Reads a run's TensorBoard event files with TensorBoard's own loader and compares them with metrics.jsonl.

Usage: python tensorboard_check.py RUN_DIR        (needs: pip install tensorboard)

Every row of metrics.jsonl must be in the events with the same f32 value, and nothing else, also after a resume.
"""

import json
import math
import struct
import sys
from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader


def as_f32(value):
    return struct.unpack("<f", struct.pack("<f", value))[0]


def main(run_dir):
    files = sorted(Path(run_dir).glob("events.out.tfevents.*"))
    assert files, f"no event files in {run_dir}"
    records = sum(sum(1 for _ in RawEventFileLoader(str(path)).Load()) for path in files)

    expected = {}
    for line in (Path(run_dir) / "metrics.jsonl").read_text().splitlines():
        row = json.loads(line)
        step, split = row.pop("step"), row.pop("split")
        for name, value in row.items():
            expected.setdefault(f"{split}/{name}", {})[step] = value

    accumulator = EventAccumulator(str(run_dir), size_guidance={"scalars": 0})
    accumulator.Reload()
    tags = accumulator.Tags()["scalars"]
    assert sorted(tags) == sorted(expected), (sorted(tags), sorted(expected))
    count = 0
    for tag in tags:
        found = [(event.step, event.value) for event in accumulator.Scalars(tag)]
        assert [step for step, _ in found] == sorted(expected[tag]), tag
        for step, value in found:
            wanted = expected[tag][step]
            same = math.isnan(value) if wanted is None else value == as_f32(wanted)
            assert same, (tag, step, value, wanted)
            count += 1
    print(f"{len(files)} files, {records} records, {len(tags)} tags, {count} values: all equal to metrics.jsonl")


if __name__ == "__main__":
    main(sys.argv[1])
