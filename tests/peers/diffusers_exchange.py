"""Opens what `diffusers_exchange write` made, compares outputs, and makes the same things the other way round."""
import os
import shutil
import sys

import torch
from diffusers import AutoencoderKL, ControlNetModel, UNet2DConditionModel
from diffusers.utils import convert_state_dict_to_diffusers
from peft import LoraConfig
from peft.utils import get_peft_model_state_dict
from safetensors.torch import load_file, save_file
from transformers import CLIPTextModel, CLIPTokenizer

CAPTIONS = ["a rainy night, two-lane road", "", "Caf\u00e9 at dusk \U0001f697, 4-lane road!"]
TOLERANCE = 1e-4
LORA = "pytorch_lora_weights.safetensors"


def compare(name, got, want):
    off = float((got - want).abs().max() / want.abs().max().clamp(min=1))
    print(f"{name:<34} off by {off:.1e}")
    assert got.shape == want.shape and off <= TOLERANCE, name


def report(name, found):
    missing, unexpected = found["missing_keys"], found["unexpected_keys"]
    assert not missing and not unexpected and not found["mismatched_keys"], (name, found)


def opened(kind, folder, **more):
    model, found = kind.from_pretrained(folder, output_loading_info=True, **more)
    report(folder, found)
    return model.eval()


@torch.no_grad()
def check(root):
    io = load_file(os.path.join(root, "io.safetensors"))
    times = torch.tensor([981, 20])
    for name in ("unet_sd15", "unet_sd21"):
        unet = opened(UNet2DConditionModel, os.path.join(root, name))
        compare(name, unet(io["sample"], times, io["text"]).sample, io[name])
        for layout in ("lora_diffusers", "lora_peft"):
            unet = opened(UNet2DConditionModel, os.path.join(root, name))
            unet.load_lora_adapter(os.path.join(root, layout, name), weight_name=LORA, prefix="unet")
            compare(f"{name} {layout}", unet(io["sample"], times, io["text"]).sample, io[f"{name}_lora"])
    vae = opened(AutoencoderKL, os.path.join(root, "vae"))
    compare("vae moments", vae._encode(io["image"]) if hasattr(vae, "_encode") else vae.encode(io["image"]).latent_dist.parameters, io["moments"])
    compare("vae decoded", vae.decode(io["latent"]).sample, io["decoded"])
    control = opened(ControlNetModel, os.path.join(root, "controlnet"))
    unet = opened(UNet2DConditionModel, os.path.join(root, "unet_sd15"))
    down, middle = control(
        io["sample"], times, io["text"], controlnet_cond=io["condition"], conditioning_scale=0.7, return_dict=False
    )
    said = unet(io["sample"], times, io["text"], down_block_additional_residuals=down, mid_block_additional_residual=middle)
    compare("unet_sd15 with controlnet", said.sample, io["controlled"])
    if "token_ids" in io:
        tokenizer = CLIPTokenizer.from_pretrained(os.path.join(root, "tokenizer"))
        ids = tokenizer(CAPTIONS, padding="max_length", truncation=True, max_length=77, return_tensors="pt").input_ids
        assert torch.equal(ids, io["token_ids"].long()), (ids, io["token_ids"])
        text = opened(CLIPTextModel, os.path.join(root, "text_encoder"))
        compare("text states", text(ids).last_hidden_state, io["text_states"])
    single = os.path.join(root, "single.safetensors")
    unet = UNet2DConditionModel.from_single_file(single, config=os.path.join(root, "unet_sd15")).eval()
    compare("unet_sd15 from the single file", unet(io["sample"], times, io["text"]).sample, io["unet_sd15"])
    vae = AutoencoderKL.from_single_file(single, config=os.path.join(root, "vae")).eval()
    compare("vae from the single file", vae.decode(io["latent"]).sample, io["decoded"])


def shaken(model, seed):
    torch.manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    return model


def write(root, back):
    """The same networks with other weights, saved by diffusers."""
    io, out, times = load_file(os.path.join(root, "io.safetensors")), {}, torch.tensor([981, 20])
    for seed, name in enumerate(("unet_sd15", "unet_sd21")):
        unet = shaken(opened(UNet2DConditionModel, os.path.join(root, name)), seed)
        unet.save_pretrained(os.path.join(back, name))
        with torch.no_grad():
            out[name] = unet(io["sample"], times, io["text"]).sample
        unet.add_adapter(LoraConfig(r=4, lora_alpha=10, target_modules=["to_q", "to_k", "to_v", "to_out.0", "conv2"]))
        shaken(unet, 10 + seed)
        # Only the adapter may differ from the saved folder.
        base = load_file(os.path.join(back, name, "diffusion_pytorch_model.safetensors"))
        with torch.no_grad():
            for key, parameter in unet.named_parameters():
                plain = key.replace(".base_layer", "")
                if plain in base:
                    parameter.copy_(base[plain])
        with torch.no_grad():
            out[f"{name}_lora"] = unet(io["sample"], times, io["text"]).sample
        unet.save_lora_adapter(os.path.join(back, "lora", name), weight_name=LORA)
    vae = shaken(opened(AutoencoderKL, os.path.join(root, "vae")), 3)
    vae.save_pretrained(os.path.join(back, "vae"))
    with torch.no_grad():
        out["moments"] = vae.encode(io["image"]).latent_dist.parameters
        out["decoded"] = vae.decode(io["latent"]).sample
    if "token_ids" in io:
        text = shaken(opened(CLIPTextModel, os.path.join(root, "text_encoder")), 4)
        text.save_pretrained(os.path.join(back, "text_encoder"))
        # transformers 5 saves tokenizer.json alone; published folders hold vocab.json and merges.txt, as ours do.
        shutil.copytree(os.path.join(root, "tokenizer"), os.path.join(back, "tokenizer"), dirs_exist_ok=True)
        with torch.no_grad():
            out["text_states"] = text(io["token_ids"].long()).last_hidden_state
    save_file({key: value.contiguous() for key, value in out.items()}, os.path.join(back, "io.safetensors"))


if __name__ == "__main__":
    ours, theirs = sys.argv[1:3]
    check(ours)
    write(ours, theirs)
    print("all outputs of our folders equal; the way back is written")
