"""Times the operations of benches/ops.rs in PyTorch, after running that bench, and prints one table of ratios.

    python benches/peer/ops.py [--threads 2] [--only TEXT]

Needs torch. The Rust figures are medians of the run that this script starts; PyTorch's are medians taken right after each other
on the same machine. A ratio below 1 means that the Rust operation is faster.
"""

import argparse
import statistics
import time

import torch
import torch.nn.functional as F

import divan


def deformable_2d(values, shapes, reference, visible, offsets, weights):
    """The composition that deformable-DETR code uses without its CUDA extension: grid_sample per level, mean over the views that see a query."""
    b, v, _, m, c = values.shape
    q, p = offsets.shape[1], offsets.shape[4]
    total, start = 0, 0
    for level, (h, w) in enumerate(shapes):
        maps = values[:, :, start:start + h * w].permute(0, 1, 3, 4, 2).reshape(b * v * m, c, h, w)
        start += h * w
        size = torch.tensor([w, h], dtype=torch.float32)
        points = reference[:, :, :, None, None] + offsets[:, None, :, :, level] / size
        grid = points.permute(0, 1, 3, 2, 4, 5).reshape(b * v * m, q, p, 2) * 2 - 1
        sampled = F.grid_sample(maps, grid, align_corners=False)
        share = weights[:, None, :, :, level].expand(b, v, q, m, p).permute(0, 1, 3, 2, 4).reshape(b * v * m, 1, q, p)
        total = total + (sampled * share).sum(-1)
    total = total.reshape(b, v, m * c, q) * visible[:, :, None].float()
    return total.sum(1) / visible.sum(1).clamp(min=1)[:, None]


def deformable_3d(values, shapes, reference, valid, offsets, weights):
    """As above with volumes and one set of points per view."""
    b, _, m, c = values.shape
    v, r, p = reference.shape[1], reference.shape[2], offsets.shape[4]
    total, start = 0, 0
    for level, (d, h, w) in enumerate(shapes):
        maps = values[:, start:start + d * h * w].permute(0, 2, 3, 1).reshape(b * m, c, d, h, w)
        start += d * h * w
        size = torch.tensor([w, h, d], dtype=torch.float32)
        points = reference.reshape(b, v * r, 1, 1, 3) + offsets[:, :, :, level] / size
        grid = points.permute(0, 2, 1, 3, 4).reshape(b * m, 1, v * r, p, 3) * 2 - 1
        sampled = F.grid_sample(maps, grid, align_corners=False)[:, :, 0]
        share = weights[:, :, :, level].permute(0, 2, 1, 3).reshape(b * m, 1, v * r, p)
        total = total + (sampled * share).sum(-1)
    return total.reshape(b, m * c, v * r) * valid.reshape(b, 1, v * r).float()


def cases():
    """Name, inputs with gradients, function of them."""
    n, u = torch.randn, torch.rand
    yield "gelu [1536, 3072]", [n(1536, 3072)], F.gelu
    yield "silu [1536, 3072]", [n(1536, 3072)], F.silu
    yield "softmax [12288, 256]", [n(12288, 256)], lambda x: F.softmax(x, -1)
    yield "layer_norm [6144, 768]", [n(6144, 768), n(768), n(768)], lambda x, g, b: F.layer_norm(x, (768,), g, b, 1e-6)
    yield "rms_norm [6144, 768]", [n(6144, 768), n(768)], lambda x, g: F.rms_norm(x, (768,), g, 1e-6)
    group = lambda x, g, b: F.silu(F.group_norm(x, 32, g, b, 1e-5))
    yield "group_norm_silu [6, 320, 28, 50]", [n(6, 320, 28, 50), n(320), n(320)], group
    for rows, i, o in [(416, 128, 512), (8192, 24, 96), (6144, 768, 3072)]:
        yield f"linear [{rows}, {i}] to {o}", [n(rows, i), n(o, i), n(o)], F.linear
    for shape in [(13, 4, 64, 32), (2, 12, 1024, 64), (1, 1, 4096, 64)]:
        yield f"attention {list(shape)}", [n(shape), n(shape), n(shape)], F.scaled_dot_product_attention
    for b, i, o, s, stride in [(13, 24, 24, 32, 1), (6, 96, 96, 64, 1), (2, 320, 320, 32, 1), (13, 16, 32, 64, 2)]:
        function = lambda x, w, bias, stride=stride: F.conv2d(x, w, bias, stride, 1)
        yield f"conv2d {b}x{i}x{s}x{s} to {o}, stride {stride}", [n(b, i, s, s), n(o, i, 3, 3), n(o)], function
    for i, o, (d, h, w) in [(24, 24, (4, 32, 32)), (96, 96, (8, 64, 64))]:
        function = lambda x, w, bias: F.conv3d(x, w, bias, 1, 1)
        yield f"conv3d 1x{i}x{d}x{h}x{w} to {o}", [n(1, i, d, h, w), n(o, i, 3, 3, 3), n(o)], function
    sample = lambda x, grid: F.grid_sample(x, grid, align_corners=False)
    yield "grid_sample_2d [6, 96, 64, 64] at 32768", [n(6, 96, 64, 64), u(6, 128, 256, 2) * 2 - 1], sample
    yield "grid_sample_3d [1, 96, 8, 64, 64] at 32768", [n(1, 96, 8, 64, 64), u(1, 8, 64, 64, 3) * 2 - 1], sample
    for share in (20, 100):
        shapes, reference, visible = [(32, 32), (16, 16), (8, 8)], u(2, 7, 4096, 2), u(2, 7, 4096) < share / 100
        inputs = [n(2, 7, 1344, 3, 8), n(2, 4096, 3, 3, 3, 2), u(2, 4096, 3, 3, 3)]
        function = lambda x, o, w, r=reference, s=visible: deformable_2d(x, shapes, r, s, o, w)
        yield f"deformable_views_2d 7 views, 4096 queries, {share} % visible", inputs, function
    volumes, points, valid = [(4, 32, 32), (2, 16, 16), (1, 8, 8)], u(2, 7, 1024, 3), u(2, 7, 1024) < 0.7
    inputs = [n(2, 4672, 3, 8), n(2, 7168, 3, 3, 4, 3), u(2, 7168, 3, 3, 4)]
    function = lambda x, o, w: deformable_3d(x, volumes, points, valid, o, w)
    yield "deformable_rays_3d 7 views, 1024 points, 70 % valid", inputs, function


def median_ms(body, least=5):
    body()
    times, begin = [], time.perf_counter()
    while len(times) < least or (time.perf_counter() - begin < 1.0 and len(times) < 200):
        start = time.perf_counter()
        body()
        times.append((time.perf_counter() - start) * 1e3)
    return statistics.median(times)


def peer(inputs, function):
    with torch.no_grad():
        forward = median_ms(lambda: function(*inputs))
    leaves = [x.clone().requires_grad_() for x in inputs]

    def both():
        for x in leaves:
            x.grad = None
        y = function(*leaves)
        y.backward(torch.ones_like(y))

    return {"forward": forward, "both": median_ms(both)}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only", default="", help="cases whose name holds this text")
    args = parser.parse_args()
    torch.manual_seed(7)
    torch.set_num_threads(args.threads)
    figures = divan.medians("ops", args.only, args.threads)
    print(f"PyTorch {torch.__version__}, {args.threads} threads, milliseconds (median)\n")
    print("| operation | forward | PyTorch | ratio | forward + backward | PyTorch | ratio |")
    print("|---|---|---|---|---|---|---|")
    for name, inputs, function in cases():
        if args.only not in name:
            continue
        theirs, cells = peer(inputs, function), []
        for kind in ("forward", "both"):
            mine = figures[kind, name]
            cells += [f"{mine:.2f}", f"{theirs[kind]:.2f}", f"{mine / theirs[kind]:.2f}"]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
