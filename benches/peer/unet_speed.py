"""Tiny UNet, forward and backward, ours against diffusers: alternating in one run, so that other load meets both.

    cargo build --release -p rigscape -p stable-diffusion --example unet_speed
    python benches/peer/unet_speed.py target/release/examples/unet_speed /tmp/unet [THREADS]

THREADS is 2 unless given; where other programs run, 1 keeps threads from waiting for each other.
"""
import os
import statistics
import subprocess
import sys
import time

import torch
from diffusers import UNet2DConditionModel

ITEMS, ROUNDS = 12, 20


def main():
    program, folder = sys.argv[1:3]
    threads = int(sys.argv[3]) if len(sys.argv) > 3 else 2
    torch.set_num_threads(threads)
    ours = subprocess.Popen(
        [program, "tiny", folder],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "RAYON_NUM_THREADS": str(threads)},
    )

    def our_step():
        ours.stdin.write("\n")
        ours.stdin.flush()
        return [float(part) for part in ours.stdout.readline().split()]

    our_step()
    unet = UNet2DConditionModel.from_pretrained(folder).train()
    sample, text, times = torch.randn(ITEMS, 4, 8, 14), torch.randn(ITEMS, 77, 64), torch.full((ITEMS,), 500)

    def their_step():
        unet.zero_grad()
        started = time.perf_counter()
        unet(sample, times, text).sample.square().mean().backward()
        return time.perf_counter() - started

    their_step(), our_step()
    pairs = [(our_step()[0], their_step()) for _ in range(ROUNDS)]
    mine, theirs = (sorted(side) for side in zip(*pairs))
    ratio = statistics.median(a / b for a, b in pairs)
    print(f"ours      {1e3 * statistics.median(mine):.1f} ms median, {1e3 * mine[0]:.1f} ms best")
    print(f"diffusers {1e3 * statistics.median(theirs):.1f} ms median, {1e3 * theirs[0]:.1f} ms best")
    print(f"ratio     {ratio:.2f} median of pairs, {mine[0] / theirs[0]:.2f} of the best")
    ours.stdin.close()
    ours.wait()


main()
