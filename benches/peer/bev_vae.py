"""Times a training step of BEV-VAE's preset `small` in PyTorch, after running benches/bev_vae.rs, and prints the ratio of times and memory.

    python benches/peer/bev_vae.py [--threads 2]

The network is written from specs/bev_vae.md, sections 3, 4 and 8; deformable attention is the composition of ops.py. Needs torch.
"""

import argparse
import math
import resource

import torch
import torch.nn.functional as F
from torch import nn

import divan
import ops

VIEWS, SIZE, PATCH, WIDTH, HEADS, BLOCKS = 6, 128, 8, 384, 6, 6
C, SCENE_HEADS, GROUPS, SCENE_BLOCKS, POINTS = 48, 3, 16, 4, (3, 4)
Z, Y, X, HALF_M, Z_RANGE = 8, 64, 64, 51.2, (-5.0, 3.0)
STATE_PATCH, STATE_BLOCKS, SQUEEZE, LATENT = 4, 4, 6, 16
DEPTHS, RAYS, BIN_M, HEIGHT_M = 30, 16, 2.0, 1.5
IMAGE_LEVELS, SCENE_LEVELS = [(64, 64), (32, 32), (16, 16)], [(2, 16, 16), (4, 32, 32), (8, 64, 64)]


def norm(width):
    return nn.LayerNorm(width, eps=1e-6, bias=False)


class Mlp(nn.Sequential):
    def __init__(self, width):
        super().__init__(nn.Linear(width, 4 * width, bias=False), nn.GELU(), nn.Linear(4 * width, width, bias=False))


def frequencies(count, width):
    return 10000.0 ** (-2 * torch.arange(count) / width)


def turn(x, angles):
    cos, sin = angles.cos(), angles.sin()
    a, b = x[..., 0::2], x[..., 1::2]
    return torch.stack([a * cos - b * sin, a * sin + b * cos], -1).flatten(-2)


class RotaryBlock(nn.Module):
    def __init__(self, width, heads):
        super().__init__()
        self.heads, head = heads, width // heads
        self.norm_1, self.norm_2, self.mlp = norm(width), norm(width), Mlp(width)
        self.qkv, self.out = nn.Linear(width, 3 * width, bias=False), nn.Linear(width, width, bias=False)
        self.q_norm, self.k_norm = nn.RMSNorm(head, 1e-6), nn.RMSNorm(head, 1e-6)

    def forward(self, x, angles):
        q, k, v = (part.unflatten(2, (self.heads, -1)).transpose(1, 2) for part in self.qkv(self.norm_1(x)).chunk(3, 2))
        y = F.scaled_dot_product_attention(turn(self.q_norm(q), angles), turn(self.k_norm(k), angles), v)
        x = x + self.out(y.transpose(1, 2).flatten(2))
        return x + self.mlp(self.norm_2(x))


class Stack(nn.Module):
    def __init__(self, width, heads, blocks, angles):
        super().__init__()
        self.blocks, self.norm = nn.ModuleList(RotaryBlock(width, heads) for _ in range(blocks)), norm(width)
        self.register_buffer("angles", angles)

    def forward(self, x):
        for block in self.blocks:
            x = block(x, self.angles)
        return self.norm(x)


def angles_2d(side, head):
    y, x = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    f = frequencies(head // 4, head / 2)
    return torch.cat([x.reshape(-1, 1) * f, y.reshape(-1, 1) * f], 1)


def angles_3d(side, heads, head):
    y, x = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    f = frequencies(head // 6, head / 3)
    plane = torch.cat([x.reshape(-1, 1) * f, y.reshape(-1, 1) * f], 1)
    height = (torch.arange(heads)[:, None] * f)[:, None].expand(heads, side * side, -1)
    return torch.cat([plane.expand(heads, -1, -1), height], 2)


def code_3d(cells):
    """[Z·Y·X, C], interleaved sin and cos of x, then y, then z."""
    z, y, x = torch.meshgrid(*(torch.arange(n) for n in cells), indexing="ij")
    f = frequencies(C // 6, C / 3)
    parts = [torch.stack([(i.reshape(-1, 1) * f).sin(), (i.reshape(-1, 1) * f).cos()], 2).flatten(1) for i in (x, y, z)]
    return torch.cat(parts, 1)


def up(c):
    return nn.Sequential(nn.ConvTranspose2d(c, c // 2, 2, 2), nn.GroupNorm(GROUPS, c // 2), nn.SiLU())


def image_head(c):
    return nn.Sequential(nn.Conv2d(c, C, 1), nn.GroupNorm(GROUPS, C), nn.SiLU(), nn.Conv2d(C, C, 3, padding=1))


def down(c):
    return nn.Sequential(nn.Conv3d(c, 2 * c, 2, 2), nn.GroupNorm(GROUPS, 2 * c), nn.SiLU())


def scene_head(c):
    return nn.Sequential(nn.Conv3d(c, C, 1), nn.GroupNorm(GROUPS, C), nn.SiLU(), nn.Conv3d(C, C, 3, padding=1))


def smooth(c):
    return nn.Sequential(nn.GroupNorm(GROUPS, c), nn.SiLU())


class SceneBlock(nn.Module):
    """Deformable attention into views (2-D) or into the grid (3-D), then MLP."""

    def __init__(self, axes, points):
        super().__init__()
        samples = SCENE_HEADS * 3 * points
        self.axes, self.points = axes, points
        self.norm_query, self.norm_value, self.norm_mlp, self.mlp = norm(C), norm(C), norm(C), Mlp(C)
        self.offset, self.weight = nn.Linear(C, samples * axes, bias=False), nn.Linear(C, samples, bias=False)
        self.out = nn.Linear(C, C, bias=False)
        if axes == 3:
            self.depth = nn.Linear(C, 1, bias=False)

    def places(self, query):
        b, q, m, p = query.shape[0], query.shape[1:-1].numel(), SCENE_HEADS, self.points
        offsets = self.offset(query).reshape(b, q, m, 3, p, self.axes)
        return offsets, self.weight(query).reshape(b, q, m, 3 * p).softmax(-1).reshape(b, q, m, 3, p)

    def encode(self, voxels, values, reference, visible):
        offsets, weights = self.places(self.norm_query(voxels))
        values = self.norm_value(values).unflatten(-1, (SCENE_HEADS, -1))
        gathered = ops.deformable_2d(values, IMAGE_LEVELS, reference, visible, offsets, weights)
        voxels = voxels + self.out(gathered.transpose(1, 2))
        return voxels + self.mlp(self.norm_mlp(voxels))

    def decode(self, points, values, reference, valid):
        query = self.norm_query(points)
        offsets, weights = self.places(query)
        values = self.norm_value(values).unflatten(-1, (SCENE_HEADS, -1))
        gathered = ops.deformable_3d(values, SCENE_LEVELS, reference, valid, offsets, weights).transpose(1, 2)
        by_depth = (points.shape[0] * VIEWS, DEPTHS, RAYS * RAYS)
        outside = ~valid.reshape(by_depth)
        share = self.depth(query).reshape(by_depth).masked_fill(outside, -1e30).softmax(1).masked_fill(outside, 0.0)
        ray = self.out((gathered.reshape(*by_depth, C) * share[..., None]).sum(1))
        points = (points.reshape(*by_depth, C) + ray[:, None]).reshape(points.shape)
        return points + self.mlp(self.norm_mlp(points))


def flatten(levels):
    return torch.cat([level.flatten(2) for level in levels], 2).transpose(1, 2)


class BevVae(nn.Module):
    def __init__(self):
        super().__init__()
        tokens, state = SIZE // PATCH, C * Z
        image = lambda: Stack(WIDTH, HEADS, BLOCKS, angles_2d(tokens, WIDTH // HEADS))
        height = lambda: Stack(state, Z, STATE_BLOCKS, angles_3d(Y // STATE_PATCH, Z, C))
        self.to_patch, self.image_encoder = nn.Conv2d(3, WIDTH, PATCH, PATCH), image()
        self.fine = nn.Sequential(up(WIDTH), up(WIDTH // 2), image_head(WIDTH // 4))
        self.middle = nn.Sequential(up(WIDTH), image_head(WIDTH // 2))
        self.coarse = nn.Sequential(smooth(WIDTH), image_head(WIDTH))
        self.pillars = nn.Parameter(torch.randn(Y * X, C) * 0.5)
        self.voxel_blocks, self.voxel_norm = nn.ModuleList(SceneBlock(2, POINTS[0]) for _ in range(SCENE_BLOCKS)), norm(C)
        self.squeeze, self.to_state, self.state_encoder = nn.Linear(C, SQUEEZE), nn.Conv2d(SQUEEZE, C, STATE_PATCH, STATE_PATCH), height()
        self.pre, self.post = nn.Linear(state, 2 * LATENT), nn.Linear(LATENT, state)
        self.state_decoder, self.from_state = height(), nn.ConvTranspose2d(C, SQUEEZE, STATE_PATCH, STATE_PATCH)
        self.expand = nn.Linear(SQUEEZE, C)
        self.scene_coarse = nn.Sequential(down(C), down(2 * C), scene_head(4 * C))
        self.scene_middle, self.scene_fine = nn.Sequential(down(C), scene_head(2 * C)), nn.Sequential(smooth(C), scene_head(C))
        self.rays = nn.Parameter(torch.randn(RAYS * RAYS, C) * 0.5)
        self.ray_blocks, self.ray_norm = nn.ModuleList(SceneBlock(3, POINTS[1]) for _ in range(SCENE_BLOCKS)), norm(C)
        self.ray_out, self.image_decoder = nn.Linear(C, WIDTH), image()
        self.pixels = nn.ConvTranspose2d(WIDTH, 3, PATCH, PATCH)
        self.register_buffer("voxel_code", code_3d((Z, Y, X)))
        self.register_buffer("ray_code", code_3d((DEPTHS, RAYS, RAYS)))

    def encode(self, images, reference, visible):
        b, side = images.shape[0], SIZE // PATCH
        tokens = self.image_encoder(self.to_patch(images.flatten(0, 1)).flatten(2).transpose(1, 2))
        picture = tokens.transpose(1, 2).unflatten(2, (side, side))
        values = flatten([self.fine(picture), self.middle(picture), self.coarse(picture)]).unflatten(0, (b, VIEWS))
        voxels = (self.pillars.repeat(Z, 1) + self.voxel_code).expand(b, -1, -1)
        for block in self.voxel_blocks:
            voxels = block.encode(voxels, values, reference, visible)
        slices = F.gelu(self.squeeze(self.voxel_norm(voxels))).reshape(b * Z, Y, X, SQUEEZE).permute(0, 3, 1, 2)
        patches = self.to_state(slices).flatten(2).unflatten(0, (b, Z)).permute(0, 3, 1, 2).flatten(2)
        mean, log_var = self.pre(self.state_encoder(patches)).chunk(2, 2)
        return mean, log_var.clamp(-30, 20)

    def decode(self, latent, reference, valid):
        b, side = latent.shape[0], Y // STATE_PATCH
        state = self.state_decoder(self.post(latent))
        slices = state.unflatten(2, (Z, C)).permute(0, 2, 3, 1).reshape(b * Z, C, side, side)
        voxels = self.expand(F.gelu(self.from_state(slices)).permute(0, 2, 3, 1))
        scene = voxels.reshape(b, Z, Y, X, C).permute(0, 4, 1, 2, 3).contiguous()
        values = flatten([self.scene_coarse(scene), self.scene_middle(scene), self.scene_fine(scene)])
        points = (self.rays.repeat(DEPTHS, 1) + self.ray_code).expand(b, VIEWS, -1, -1)
        for block in self.ray_blocks:
            points = block.decode(points, values, reference, valid)
        rays = self.ray_norm(points.reshape(b * VIEWS, DEPTHS, RAYS * RAYS, C).mean(1))
        tokens = self.image_decoder(self.ray_out(rays))
        side = SIZE // PATCH
        return self.pixels(tokens.transpose(1, 2).unflatten(2, (side, side))).unflatten(0, (b, VIEWS))

    def forward(self, images, voxels, rays):
        mean, log_var = self.encode(images, *voxels)
        decoded = self.decode(mean + (log_var / 2).exp() * torch.randn_like(mean), *rays)
        kl = 0.5 * (mean.square() + log_var.exp() - 1 - log_var).sum((1, 2))
        return (decoded - images).square().mean() + 1e-6 * kl.mean()


def sample_points():
    """Voxel centres in six cameras of 90 degrees, camera i looking along yaw 60 i degrees, and frustum points in the grid."""
    yaw = torch.arange(VIEWS) * (2 * math.pi / VIEWS)
    zero = torch.zeros(VIEWS)
    right, forward = torch.stack([yaw.sin(), -yaw.cos(), zero], 1), torch.stack([yaw.cos(), yaw.sin(), zero], 1)
    down = torch.tensor([0.0, 0.0, -1.0]).expand(VIEWS, 3)
    axes, place = torch.stack([right, down, forward], 1), torch.tensor([0.0, 0.0, HEIGHT_M])
    centres = [torch.linspace(low, high, 2 * n + 1)[1::2] for (low, high), n in zip((Z_RANGE, (-HALF_M, HALF_M), (-HALF_M, HALF_M)), (Z, Y, X))]
    z, y, x = torch.meshgrid(*centres, indexing="ij")
    ego = torch.stack([x, y, z], -1).reshape(-1, 3)
    cam = torch.einsum("vij,nj->vni", axes, ego - place)
    unit = cam[..., :2] / cam[..., 2:].clamp(min=1e-6) * 0.5 + 0.5
    visible = (cam[..., 2] > 1e-6) & ((unit > 0) & (unit < 1)).all(-1)
    lattice = (torch.arange(RAYS) + 0.5) / RAYS * 2 - 1
    depth = (torch.arange(DEPTHS) + 0.5) * BIN_M
    d, v, u = torch.meshgrid(depth, lattice, lattice, indexing="ij")
    points = torch.einsum("vij,ni->vnj", axes, torch.stack([u * d, v * d, d], -1).reshape(-1, 3)) + place
    low = torch.tensor([-HALF_M, -HALF_M, Z_RANGE[0]])
    rays = (points - low) / torch.tensor([2 * HALF_M, 2 * HALF_M, Z_RANGE[1] - Z_RANGE[0]])
    valid = ((rays > 0) & (rays < 1)).all(-1)
    voxels = (unit * visible[..., None])[None], visible[None]
    return voxels, ((rays * valid[..., None])[None], valid[None])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    mine = divan.medians("bev_vae", "", args.threads, package="vae")[None, "small"]
    ours_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    network = BevVae()
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-4, weight_decay=0.01)
    voxels, rays = sample_points()
    print(f"visible {voxels[1].float().mean():.3f} of voxels and views, valid {rays[1].float().mean():.3f} of ray points")
    images = torch.randn(1, VIEWS, 3, SIZE, SIZE)

    def step():
        optimizer.zero_grad()
        network(images, voxels, rays).backward()
        optimizer.step()

    theirs = ops.median_ms(step, least=4)
    theirs_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    parameters = sum(p.numel() for p in network.parameters())
    print(f"PyTorch {torch.__version__}, {args.threads} threads, {parameters} parameters: {theirs:.0f} ms, peak {theirs_mb:.0f} MB")
    print(f"rigscape: {mine:.0f} ms, peak {ours_mb:.0f} MB (the largest child process, which may be the compiler: build first)")
    print(f"ratio of times {mine / theirs:.2f}, of peaks {ours_mb / theirs_mb:.2f}")


if __name__ == "__main__":
    main()
