"""Writes the small torch files under crates/nn/tests/fixtures with PyTorch itself, in every packing and element type."""
import collections
import pathlib
import sys

import torch


class Node:
    """Stands for the configuration objects of Lightning checkpoints: a class no reader knows, with a circle in it."""

    def __init__(self, parent=None):
        self.parent = parent
        self.child = Node(self) if parent is None else None


def every_type():
    floats = torch.tensor([-2.0, 0.0, 1.5, 3.0])
    tensors = {str(t).split(".")[1]: floats.to(t) for t in (torch.float64, torch.float32, torch.float16, torch.bfloat16)}
    integers = torch.tensor([-2, 0, 1, 3])
    tensors |= {str(t).split(".")[1]: integers.to(t) for t in (torch.int64, torch.int32, torch.int16, torch.int8)}
    return tensors | {"uint8": torch.tensor([0, 1, 2, 255], dtype=torch.uint8), "bool": torch.tensor([True, False])}


def every_layout():
    table = torch.arange(12.0).reshape(3, 4)
    state = collections.OrderedDict()
    state["whole"] = table
    state["transposed"] = table.t()
    state["columns"] = table[:, 1:3]
    state["every_second"] = table.flatten()[1::2]
    state["empty"] = torch.zeros(0, 3)
    state["scalar"] = torch.tensor(7.0)
    state["parameter"] = torch.nn.Parameter(torch.tensor([1.0, 2.0]))
    state["_extra_state"] = None
    return state


def lightning():
    layer = torch.nn.Linear(2, 1)
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[0.5, -0.5]]))
        layer.bias.fill_(0.25)
    optimizer = torch.optim.Adam(layer.parameters())
    layer(torch.ones(1, 2)).sum().backward()
    optimizer.step()
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[0.5, -0.5]]))
        layer.bias.fill_(0.25)
    return {
        "epoch": 3,
        "global_step": 2**40,
        "state_dict": collections.OrderedDict((f"matcher.{k}", v) for k, v in layer.state_dict().items()),
        "optimizer_states": [optimizer.state_dict()],
        "callbacks": {Node: {"best": torch.tensor(1.0)}},
        "hyper_parameters": Node(),
        "loops": {1, 2},
    }


def main(out):
    out.mkdir(parents=True, exist_ok=True)
    small = {"w": torch.tensor([1.0])}
    torch.save(every_type(), out / "types.pth")
    torch.save(every_type(), out / "types_legacy.pth", _use_new_zipfile_serialization=False)
    torch.save(every_layout(), out / "layouts.pth")
    torch.save(every_layout(), out / "layouts_legacy.pth", _use_new_zipfile_serialization=False)
    torch.save(every_type(), out / "types_protocol4.bin", pickle_protocol=4)
    torch.save(lightning(), out / "lightning.ckpt")
    torch.save({"ema": small, "model": {"inner": {"w": torch.tensor([2.0])}}, "net": small}, out / "several.pt")
    torch.save({"model": small, "epoch": 3}, out / "only_one.pt")
    torch.save({"w": torch.zeros(1).expand(1000, 1000)}, out / "expanded.pth")
    torch.save(torch.nn.Linear(1, 1), out / "module.pt")
    torch.jit.save(torch.jit.script(torch.nn.ReLU()), out / "script.pt")
    for file in sorted(out.iterdir()):
        print(f"{file.name:20} {file.stat().st_size:6} bytes")


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
