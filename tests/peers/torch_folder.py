"""Writes crates/stable-diffusion/tests/fixtures with PyTorch itself: the autoencoder of a diffusers folder as older releases
published it, once as `.bin` in half precision, once inside a Lightning `.ckpt` under the names of CompVis/latent-diffusion."""
import pathlib
import re
import shutil
import sys

import safetensors.torch
import torch

ATTENTION = {"group_norm": "norm", "to_q": "q", "to_k": "k", "to_v": "v", "to_out.0": "proj_out"}


def original(name, levels):
    """The name in a single file for a name of diffusers."""
    name = name.replace("conv_norm_out", "norm_out").replace("conv_shortcut", "nin_shortcut")
    name = re.sub(r"mid_block\.resnets\.(\d)", lambda m: f"mid.block_{int(m[1]) + 1}", name)
    name = re.sub(r"mid_block\.attentions\.0\.(\w+(?:\.0)?)", lambda m: f"mid.attn_1.{ATTENTION[m[1]]}", name)
    name = re.sub(r"down_blocks\.(\d)\.resnets\.(\d)", r"down.\1.block.\2", name)
    name = re.sub(r"down_blocks\.(\d)\.downsamplers\.0", r"down.\1.downsample", name)
    name = re.sub(r"up_blocks\.(\d)\.resnets\.(\d)", lambda m: f"up.{levels - 1 - int(m[1])}.block.{m[2]}", name)
    name = re.sub(r"up_blocks\.(\d)\.upsamplers\.0", lambda m: f"up.{levels - 1 - int(m[1])}.upsample", name)
    return "first_stage_model." + name


def main(vae, out):
    out.mkdir(parents=True, exist_ok=True)
    state = safetensors.torch.load_file(vae / "diffusion_pytorch_model.safetensors")
    half = {name: value.half() for name, value in state.items()}
    (out / "vae").mkdir(exist_ok=True)
    shutil.copy(vae / "config.json", out / "vae/config.json")
    torch.save(half, out / "vae/diffusion_pytorch_model.fp16.bin")
    levels = 1 + max(int(name.split(".")[2]) for name in state if name.startswith("decoder.up_blocks."))
    single = {}
    for name, value in half.items():
        theirs = original(name, levels)
        convolution = ".attn_1." in theirs and ".norm." not in theirs and theirs.endswith("weight")
        single[theirs] = value[:, :, None, None] if convolution else value
    others = {"alphas_cumprod": torch.tensor([0.9, 0.5, 0.1]), "model_ema.num_updates": torch.tensor(7)}
    torch.save({"epoch": 1, "global_step": 10, "state_dict": single | others, "loops": {1, 2}}, out / "v1.ckpt")
    for file in sorted(out.rglob("*.*")):
        print(f"{str(file.relative_to(out)):40} {file.stat().st_size:7} bytes")


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]))
