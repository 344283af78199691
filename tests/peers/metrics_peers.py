"""The same folders through `rigscape evaluate` and through scikit-image, torchmetrics, pytorch-fid; both numbers side by side.

    python tests/peers/metrics_peers.py RIGSCAPE WEIGHTS PHOTOS

RIGSCAPE is the program, WEIGHTS a folder with efficientnet_lite0_imagenet.safetensors, PHOTOS a folder of photographs. Two folders of crops are
written, the second one blurred and noisy. Feature distances use the same EfficientNet-Lite0 on both sides, because the official Inception weights
are on no package index; so the formulas, resizes and statistics are compared, not the network.
"""

import json
import os
import subprocess
import sys
import tempfile

import numpy as np
import torch
from efficientnet_lite0 import EfficientNetLite0
from PIL import Image, ImageFilter
from pytorch_fid.fid_score import calculate_frechet_distance
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import multiscale_structural_similarity_index_measure
from torchmetrics.image.fid import FrechetInceptionDistance
from torchmetrics.image.kid import KernelInceptionDistance

PROTOCOLS = "psnr/bev-vae,ssim/skimage7,ssim/gauss11,ms_ssim/gauss11,fid/plain,kid/plain"


def write_sets(photos, folder):
    rng = np.random.default_rng(0)
    paths = sorted(os.path.join(root, name) for root, _, names in os.walk(photos) for name in names if name.endswith((".jpg", ".png")))
    count = 0
    for path in paths:
        whole = Image.open(path).convert("RGB").resize((800, 450), Image.BICUBIC)
        for left in range(0, 800 - 256, 136):
            for top in (0, 194):
                real = whole.crop((left, top, left + 256, top + 256))
                blurred = np.asarray(real.filter(ImageFilter.GaussianBlur(1.0)), dtype=np.float64)
                generated = np.clip(blurred + rng.normal(0.0, 6.0, blurred.shape), 0, 255).round().astype(np.uint8)
                for side, picture in (("real", real), ("generated", Image.fromarray(generated))):
                    os.makedirs(os.path.join(folder, side), exist_ok=True)
                    picture.save(os.path.join(folder, side, f"{count:04}.png"))
                count += 1
    return count


def read(folder):
    return [np.asarray(Image.open(os.path.join(folder, name))) for name in sorted(os.listdir(folder))]


class Resized(torch.nn.Module):
    """The stand-in of the program: Pillow's bicubic resize of bytes to 224x224, then EfficientNet-Lite0."""

    num_features = EfficientNetLite0.num_features

    def __init__(self, weights):
        super().__init__()
        self.network = EfficientNetLite0(weights)

    def forward(self, pictures):
        small = [Image.fromarray(picture.permute(1, 2, 0).numpy()).resize((224, 224), Image.BICUBIC) for picture in pictures]
        rows = [self.network(torch.from_numpy(np.asarray(one).copy()).permute(2, 0, 1)[None].float() / 255) for one in small]
        return torch.cat(rows)


def ours(program, weights, folder):
    sides = ["--real", f"{folder}/real", "--generated", f"{folder}/generated"]
    command = [program, "evaluate", *sides, "--weights", weights, "--protocol", PROTOCOLS, "--out", f"{folder}/out"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    for side in ("real", "generated"):
        command = [program, "evaluate", "--generated", f"{folder}/{side}", "--weights", weights, "--protocol", "fid/plain"]
        subprocess.run([*command, "--save-stats", f"{folder}/{side}.npz"], check=True, stdout=subprocess.DEVNULL)
    with open(f"{folder}/out/report.json") as file:
        return {one["protocol"]: one for one in json.load(file)["metrics"]}


def line(what, mine, peer):
    print(f"{what:<58} {mine:>18.12f} {peer:>18.12f} {abs(mine - peer):>9.1e}")


def main():
    program, weights, photos = sys.argv[1:4]
    with tempfile.TemporaryDirectory() as folder:
        count = write_sets(photos, folder)
        found = ours(program, weights, folder)
        real, generated = read(f"{folder}/real"), read(f"{folder}/generated")
        pairs = [(a / 255.0, b / 255.0) for a, b in zip(real, generated)]
        print(f"{count} pairs of 256x256 pictures\n{'':<58} {'rigscape':>18} {'peer':>18} {'apart':>9}")
        value = lambda name: found[name]["value"]
        psnr = np.mean([peak_signal_noise_ratio(a, b, data_range=1) for a, b in pairs])
        line("PSNR dB, scikit-image", value("psnr/bev-vae"), psnr)
        uniform = np.mean([structural_similarity(a, b, channel_axis=2, data_range=1) for a, b in pairs])
        line("SSIM 7x7, scikit-image", value("ssim/skimage7"), uniform)
        options = dict(channel_axis=2, data_range=1, gaussian_weights=True, sigma=1.5, use_sample_covariance=False)
        gauss = np.mean([structural_similarity(a, b, **options) for a, b in pairs])
        line("SSIM 11x11, scikit-image", value("ssim/gauss11"), gauss)
        tensor = lambda picture: torch.from_numpy(picture).permute(2, 0, 1)[None]
        scales = [multiscale_structural_similarity_index_measure(tensor(b), tensor(a), data_range=1.0).item() for a, b in pairs]
        line("MS-SSIM, torchmetrics (it pads borders; 1e-5 expected)", value("ms_ssim/gauss11"), np.mean(scales))
        features(weights, folder, real, generated, value)


def features(weights, folder, real, generated, value):
    saved = [np.load(f"{folder}/{side}.npz") for side in ("generated", "real")]
    distance = calculate_frechet_distance(saved[0]["mu"], saved[0]["sigma"], saved[1]["mu"], saved[1]["sigma"])
    line("Frechet distance, pytorch-fid on our --save-stats .npz", value("fid/plain"), distance)
    network = Resized(weights)
    batch = lambda pictures: torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2)
    fid = FrechetInceptionDistance(feature=network, normalize=False, input_img_size=(3, 256, 256))
    fid.set_dtype(torch.float64)
    size = min(1000, len(real))
    kid = KernelInceptionDistance(feature=network, normalize=False, subsets=1, subset_size=size)
    for metric in (fid, kid):
        metric.update(batch(real), real=True)
        metric.update(batch(generated), real=False)
    line("Frechet distance, torchmetrics with the network in PyTorch", value("fid/plain"), fid.compute().item())
    line("KID of all samples, torchmetrics with the network in PyTorch", value("kid/plain"), kid.compute()[0].item())


if __name__ == "__main__":
    main()
