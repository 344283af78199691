"""Times the training steps of benches/steps.rs in PyTorch, after running that bench, and prints one table of ratios.

    python benches/peer/steps.py [--threads 2]

Needs torch. The networks are written from specs/dit.md and specs/stable_diffusion.md; see ops.py for how the figures are taken.
"""

import argparse

import torch
import torch.nn.functional as F
from torch import nn

import divan
import ops


def attend(q, k, v, heads):
    split = lambda x: x.unflatten(2, (heads, -1)).transpose(1, 2)
    return F.scaled_dot_product_attention(split(q), split(k), split(v)).transpose(1, 2).flatten(2)


class DitBlock(nn.Module):
    def __init__(self, width=384, heads=6):
        super().__init__()
        self.heads, self.norm = heads, nn.LayerNorm(width, eps=1e-6, elementwise_affine=False)
        self.modulation, self.qkv, self.out = nn.Linear(width, 6 * width), nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.expand, self.contract = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, x, c):
        shift_1, scale_1, gate_1, shift_2, scale_2, gate_2 = self.modulation(F.silu(c))[:, None].chunk(6, 2)
        q, k, v = self.qkv(self.norm(x) * (1 + scale_1) + shift_1).chunk(3, 2)
        x = x + self.out(attend(q, k, v, self.heads)) * gate_1
        hidden = F.gelu(self.expand(self.norm(x) * (1 + scale_2) + shift_2), approximate="tanh")
        return x + self.contract(hidden) * gate_2


class DitStack(nn.Module):
    def __init__(self):
        super().__init__()
        self.blocks = nn.ModuleList(DitBlock() for _ in range(4))

    def forward(self, x, c):
        for block in self.blocks:
            x = block(x, c)
        return x


class UnetLevel(nn.Module):
    def __init__(self, width=320, heads=8, text=768):
        super().__init__()
        self.heads = heads
        self.norm_1, self.norm_2 = nn.GroupNorm(32, width), nn.GroupNorm(32, width)
        self.conv_1, self.conv_2 = nn.Conv2d(width, width, 3, padding=1), nn.Conv2d(width, width, 3, padding=1)
        self.time, self.entrance = nn.Linear(4 * width, width), nn.GroupNorm(32, width, eps=1e-6)
        self.proj_in, self.proj_out = nn.Linear(width, width), nn.Linear(width, width)
        self.layers = nn.ModuleList(nn.LayerNorm(width) for _ in range(3))
        self.attention = nn.ModuleList(nn.Linear(d, width) for d in [width] * 5 + [text, text, width])
        self.expand, self.contract = nn.Linear(width, 8 * width), nn.Linear(4 * width, width)

    def attend(self, first, x, context):
        q, k, v, out = self.attention[first:first + 4]
        return out(attend(q(x), k(context), v(context), self.heads))

    def forward(self, x, time, text):
        hidden = self.conv_1(F.silu(self.norm_1(x))) + self.time(F.silu(time))[:, :, None, None]
        x = x + self.conv_2(F.silu(self.norm_2(hidden)))
        tokens = self.proj_in(self.entrance(x).flatten(2).transpose(1, 2))
        normed = self.layers[0](tokens)
        tokens = tokens + self.attend(0, normed, normed)
        tokens = tokens + self.attend(4, self.layers[1](tokens), text)
        values, gates = self.expand(self.layers[2](tokens)).chunk(2, 2)
        tokens = tokens + self.contract(values * F.gelu(gates))
        return x + self.proj_out(tokens).transpose(1, 2).reshape(x.shape)


def step_ms(network, inputs):
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-4, weight_decay=0.01)

    def step():
        optimizer.zero_grad()
        network(*inputs).square().mean().backward()
        optimizer.step()

    return ops.median_ms(step)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    n = torch.randn
    cases = {
        "dit_stack": (DitStack, [n(4, 256, 384), n(4, 384)]),
        "unet_level": (UnetLevel, [n(2, 320, 28, 50), n(2, 1280), n(2, 77, 768)]),
    }
    figures = divan.medians("steps", "", args.threads)
    print(f"PyTorch {torch.__version__}, {args.threads} threads, milliseconds (median)\n")
    print("| step | rigscape | PyTorch | ratio |\n|---|---|---|---|")
    for name, (network, inputs) in cases.items():
        theirs = step_ms(network(), inputs)
        print(f"| {name} | {figures[None, name]:.1f} | {theirs:.1f} | {figures[None, name] / theirs:.2f} |", flush=True)


if __name__ == "__main__":
    main()
