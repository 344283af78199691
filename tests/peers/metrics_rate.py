"""PSNR, SSIM 11x11 and a Frechet distance of made six-view frames in PyTorch: the peer of `cargo bench --bench evaluate`.

    python tests/peers/metrics_rate.py FRAMES [WEIGHTS]

With a folder of weights the distance looks through EfficientNet-Lite0 as in metrics_peers.py (the resize runs in PyTorch), else through the mean
colours of an 8x8 grid. The pictures are the same as in the bench; making them is not counted here.
"""

import sys
import time

import numpy as np
import torch
from pytorch_fid.fid_score import calculate_frechet_distance
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

SIDE, VIEWS = 256, 6


def made(index, noise):
    at = np.arange(SIDE * SIDE * 3, dtype=np.uint32)
    x, y, c = at // 3 % SIDE, at // 3 // SIDE, at % 3
    views = []
    for view in range(VIEWS):
        seed = np.uint32(index * VIEWS + view)
        wave = (x * (3 + seed % 5) + y * (2 + seed % 7) + 40 * c + seed) // 4 % 160
        grain = ((at ^ seed) * np.uint32(2654435761)) >> 27
        views.append(np.minimum(wave + grain * noise, 255).astype(np.uint8).reshape(SIDE, SIDE, 3))
    return torch.from_numpy(np.stack(views)).permute(0, 3, 1, 2).contiguous()


def efficientnet(weights):
    from efficientnet_lite0 import EfficientNetLite0

    network = EfficientNetLite0(weights)
    resize = lambda x: torch.nn.functional.interpolate(x, (224, 224), mode="bicubic", antialias=True).clamp(0, 1)
    return lambda pictures: network(resize(pictures.float() / 255))


def grid(pictures):
    return torch.nn.functional.interpolate(pictures.float() / 255, (8, 8), mode="bilinear", antialias=True).flatten(1)


@torch.no_grad()
def main():
    frames = int(sys.argv[1])
    features = efficientnet(sys.argv[2]) if len(sys.argv) > 2 else grid
    pairs = [(made(index, 0), made(index, 1)) for index in range(min(frames, 24))]
    seconds = {"PSNR": 0.0, "SSIM 11x11": 0.0, "features": 0.0, "distance": 0.0}
    rows = [[], []]

    def timed(what, call):
        start = time.perf_counter()
        found = call()
        seconds[what] += time.perf_counter() - start
        return found

    psnr, ssim = [], []
    for index in range(frames):
        real, generated = pairs[index % len(pairs)]
        a, b = real.float() / 255, generated.float() / 255
        psnr.append(timed("PSNR", lambda: peak_signal_noise_ratio(b, a, data_range=1.0, dim=(1, 2, 3), reduction="elementwise_mean").item()))
        ssim.append(timed("SSIM 11x11", lambda: structural_similarity_index_measure(b, a, data_range=1.0).item()))
        for side, pictures in enumerate((real, generated)):
            rows[side].append(timed("features", lambda: features(pictures)).numpy().astype(np.float64))
    sets = [np.concatenate(side) for side in rows]
    moments = [(side.mean(0), np.cov(side, rowvar=False)) for side in sets]
    distance = timed("distance", lambda: calculate_frechet_distance(*moments[1], *moments[0]))
    print(f"{torch.get_num_threads()} threads, torch {torch.__version__}; PSNR {np.mean(psnr):.3f} dB, SSIM {np.mean(ssim):.5f}, distance {distance:.4f}")
    for what, spent in seconds.items():
        print(f"{what:<12} {frames / spent:>9.2f} frames/s")
    print(f"{'together':<12} {frames / sum(seconds.values()):>9.2f} frames/s")


if __name__ == "__main__":
    main()
