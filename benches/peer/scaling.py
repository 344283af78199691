"""Runs benches/scaling.rs and draws the time of deformable sampling over queries and views, with a line in proportion for comparison.

    python benches/peer/scaling.py [--threads 2] [--out benches/pictures/sampling_scale.png]

Needs matplotlib.
"""

import argparse

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import divan


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", default="benches/pictures/sampling_scale.png")
    args = parser.parse_args()
    figures = divan.medians("scaling", "", args.threads)
    figure, axes = plt.subplots(1, 2, figsize=(10, 4))
    for axis, what, fixed in zip(axes, ("queries", "views"), ("6 views", "4096 queries")):
        for kind, label in (("forward", "forward"), ("both", "forward + backward")):
            points = sorted((int(size), ms) for (name, size), ms in figures.items() if name == f"{what}_{kind}")
            sizes, times = zip(*points)
            (line,) = axis.plot(sizes, times, "o-", label=label)
            axis.plot(sizes, [times[-1] * size / sizes[-1] for size in sizes], "--", color=line.get_color(), linewidth=0.8)
            print(f"{what}, {label}: " + ", ".join(f"{size} {ms:.2f} ms" for size, ms in points))
        axis.set(xlabel=f"{what} ({fixed})", ylabel="ms", xscale="log", yscale="log", title=f"deformable_views_2d over {what}")
        axis.legend()
        axis.grid(True, which="both", alpha=0.3)
    figure.tight_layout()
    figure.savefig(args.out, dpi=100)


if __name__ == "__main__":
    main()
