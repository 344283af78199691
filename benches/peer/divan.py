"""Runs a Rust bench and reads the table that divan prints."""

import os
import re
import subprocess


def medians(bench, only, threads, package="ops"):
    """Medians in milliseconds by (name of the function, argument), or (None, name) without arguments."""
    command = ["cargo", "bench", "-q", "-p", "rigscape", "-p", package, "--bench", bench, "--", only]
    output = subprocess.run(command, check=True, env={**os.environ, "RAYON_NUM_THREADS": str(threads)}, capture_output=True, text=True).stdout
    factor = {"ns": 1e-6, "µs": 1e-3, "ms": 1.0, "s": 1e3}
    figures, kind = {}, None
    for line in output.splitlines():
        if not (row := re.match(r"(│  |   )?[├╰]─ (.*)", line)):
            continue
        cells = [cell.strip() for cell in row[2].split("│")]
        timed = re.match(r"(.*?)\s{2,}[\d.]+ \S+$", cells[0])
        if not row[1]:
            kind = cells[0]
        if timed:
            number, unit = cells[2].split()
            figures[kind if row[1] else None, timed[1]] = float(number) * factor[unit]
    return figures
