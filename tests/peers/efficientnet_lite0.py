"""EfficientNet-Lite0 up to its pooled features in PyTorch, for the scripts beside this file."""

import os

import torch
from safetensors.torch import load_file
from torch.nn.functional import conv2d, pad

STAGES = [(1, 3, 1, 1, 32, 16), (2, 3, 2, 6, 16, 24), (2, 5, 2, 6, 24, 40), (3, 3, 2, 6, 40, 80), (3, 5, 1, 6, 80, 112), (4, 5, 2, 6, 112, 192), (1, 3, 1, 6, 192, 320)]


class EfficientNetLite0(torch.nn.Module):
    """Rows of 1280 numbers from pictures [N, 3, 224, 224] in [0, 1]."""

    num_features = 1280

    def __init__(self, weights):
        super().__init__()
        self.tensors = load_file(os.path.join(weights, "efficientnet_lite0_imagenet.safetensors"))

    def layer(self, x, conv, norm, stride=1, groups=1, relu=True):
        weight = self.tensors[conv + ".weight"]
        stay = [max((-(-side // stride) - 1) * stride + weight.shape[-1] - side, 0) for side in x.shape[-2:]]
        x = pad(x, (stay[1] // 2, stay[1] - stay[1] // 2, stay[0] // 2, stay[0] - stay[0] // 2))
        names = ("running_mean", "running_var", "weight", "bias")
        x = torch.nn.functional.batch_norm(conv2d(x, weight, stride=stride, groups=groups), *(self.tensors[f"{norm}.{name}"] for name in names), eps=1e-3)
        return torch.clamp(x, 0, 6) if relu else x

    @torch.no_grad()
    def forward(self, pictures):
        x = self.layer((pictures * 255 - 127) / 128, "_conv_stem", "_bn0", 2)
        block = 0
        for repeats, _, first_stride, expansion, into, out in STAGES:
            for repeat in range(repeats):
                stride, channels = (first_stride, into) if repeat == 0 else (1, out)
                name, y = f"_blocks.{block}", x
                if expansion > 1:
                    y = self.layer(y, f"{name}._expand_conv", f"{name}._bn0")
                y = self.layer(y, f"{name}._depthwise_conv", f"{name}._bn1", stride, channels * expansion)
                y = self.layer(y, f"{name}._project_conv", f"{name}._bn2", relu=False)
                x = x + y if stride == 1 and channels == out else y
                block += 1
        return self.layer(x, "_conv_head", "_bn1").mean((2, 3))
