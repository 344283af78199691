"""Writes a Lightning-like checkpoint of the golden BEV-VAE weights with PyTorch, and checks what `rigscape import bev-vae` made of it.

    bev_vae_lightning.py make GOLDEN_DIR CASE OUT_DIR     writes OUT_DIR/official.ckpt and OUT_DIR/model.toml
    bev_vae_lightning.py check GOLDEN_DIR CASE RUN_DIR    compares RUN_DIR's checkpoint number by number
"""
import collections
import json
import math
import pathlib
import re
import sys

import numpy as np
import safetensors.numpy
import torch

MASK = (1 << 64) - 1


def golden(name, shape):
    """The rule of GOLDEN_INIT.md, with gains for `.scale`."""
    seed = 0xCBF29CE484222325
    for byte in name.encode():
        seed = (seed ^ byte) * 0x100000001B3 & MASK
    count = math.prod(shape)
    with np.errstate(over="ignore"):
        z = np.uint64(seed) + np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z ^= z >> np.uint64(31)
    x = 2.0 * (z >> np.uint64(40)).astype(np.float64) / 2**24 - 1.0
    if len(shape) >= 2:
        x = x * math.sqrt(3.0 / math.prod(shape[1:]))
    elif name.endswith(("weight", "gamma", ".scale")):
        x = 1.0 + 0.1 * x
    else:
        x = 0.1 * x
    return torch.from_numpy(x.astype(np.float32).reshape(shape))


def parameters(folder, case):
    entries = json.loads((folder / "manifest.json").read_text())[case]["parameters"]
    return [(entry["name"], entry["shape"], entry.get("kind") == "buffer") for entry in entries]


def model_table(config):
    """The [model] table of these sizes."""
    height, width = config["image_size"]
    low, high = config["pc"][:3], config["pc"][3:]
    image, scene, state = config["image"], config["scene"], config["state"]
    depths, rows, columns = config["frustum_size"]
    return f"""[model]
preset = "paper"
latent_channels = {config["latent_ch"]}
image = {{ height = {height}, width = {width}, patch = {config["patch_size"]}, channels = {image["ch"]}, heads = {image["heads"]}, encoder_blocks = {image["blocks"]}, decoder_blocks = {image["blocks"]} }}
scene = {{ channels = {scene["ch"]}, heads = {scene["heads"]}, encoder_blocks = {scene["blocks"]}, decoder_blocks = {scene["blocks"]}, encoder_points = {scene["enc_points"]}, decoder_points = {scene["dec_points"]} }}
grid = {{ x_range = [{low[0]}, {high[0]}], y_range = [{low[1]}, {high[1]}], z_range = [{low[2]}, {high[2]}], cells = {config["scene_size"]} }}
state = {{ patch = {state["patch_size"]}, channels_per_height = {state["ch_per_height"]}, squeeze_channels = {state["mid_ch"]}, blocks = {state["blocks"]} }}
frustum = {{ depths = {depths}, bin_m = 1.0, rows = {rows}, columns = {columns} }}
"""


def make(folder, case, out):
    out.mkdir(parents=True, exist_ok=True)
    config = json.loads((folder / "cases.json").read_text())[case]["config"]
    (out / "model.toml").write_text(model_table(config))
    state, averages = collections.OrderedDict(), []
    for name, shape, is_buffer in parameters(folder, case):
        state[name] = torch.full(shape, 0.5)
        if not is_buffer:
            averages.append(torch.nn.Parameter(golden(name, shape), requires_grad=False))
    state["evaluation.fid.weight"] = torch.zeros(3)
    # Of a discriminator.
    averages.append(torch.ones(5))
    optimizer = {"state": {0: {"step": torch.tensor(7.0), "exp_avg": torch.zeros(2)}}, "param_groups": [], "ema": averages}
    torch.save({
        "epoch": 2,
        "global_step": 7,
        "pytorch-lightning_version": "2.6.6",
        "state_dict": state,
        "optimizer_states": [optimizer],
        "lr_schedulers": [],
        "callbacks": {"ModelCheckpoint{'monitor': None}": {"best_model_score": torch.tensor(1.0)}},
        "hyper_parameters": {"lr": 1e-4},
    }, out / "official.ckpt")
    print(f"{len(state)} keys, {len(averages)} averages, {(out / 'official.ckpt').stat().st_size} bytes")


def check(folder, case, run):
    (checkpoint,) = (run / "checkpoints").iterdir()
    shapes = {name: shape for name, shape, is_buffer in parameters(folder, case) if not is_buffer}
    rows = re.findall(r"^\| (\S+) \| (\S+) \| \[.*\] \| taken \|$", (run / "import.md").read_text(), re.M)
    assert len(rows) == len(shapes), f"{len(rows)} keys taken of {len(shapes)}"
    average, current = (safetensors.numpy.load_file(checkpoint / f"{part}.safetensors") for part in ("ema", "model"))
    assert set(average) == {ours for _, ours in rows}
    for official, ours in rows:
        wanted = golden(official, shapes[official]).numpy()
        assert np.array_equal(average[ours].ravel(), wanted.ravel()), f"{ours} differs from {official}"
        assert (current[ours] == 0.5).all(), f"{ours} of the last step"
    print(f"{len(rows)} parameters equal bit for bit, {sum(value.size for value in average.values())} numbers")


if __name__ == "__main__":
    command, folder, case, place = sys.argv[1], pathlib.Path(sys.argv[2]), sys.argv[3], pathlib.Path(sys.argv[4])
    {"make": make, "check": check}[command](folder, case, place)
