"""Loads generated pictures in tables made from frames (`rigscape synthesize --export nuscenes`) with the official devkit.

    python nuscenes_generated_check.py DIR [--version v1.0-generated]

Such folders have empty lidar files and a blank map; whatever else a user relies on is checked. Ends non-zero at the first failure.
"""

import argparse
import os

from nuscenes.nuscenes import NuScenes
from nuscenes.utils.geometry_utils import BoxVisibility
from PIL import Image


def require(holds, text):
    if not holds:
        raise SystemExit(f"FAILED: {text}")


def check_pictures(nusc):
    seen, pictures = 0, 0
    for sample in nusc.sample:
        for channel, token in sample["data"].items():
            path, boxes, _ = nusc.get_sample_data(token, box_vis_level=BoxVisibility.ANY)
            require(os.path.exists(path), f"{path} is missing")
            if channel == "LIDAR_TOP":
                continue
            row = nusc.get("sample_data", token)
            require(Image.open(path).size == (row["width"], row["height"]), f"size of {path}")
            pictures, seen = pictures + 1, seen + len(boxes)
    return pictures, seen


def check_chains(nusc):
    for scene in nusc.scene:
        token, count, last = scene["first_sample_token"], 0, ""
        while token:
            count, last, token = count + 1, token, nusc.get("sample", token)["next"]
        require((count, last) == (scene["nbr_samples"], scene["last_sample_token"]), f"chain of {scene['name']}")
    for instance in nusc.instance:
        token, count = instance["first_annotation_token"], 0
        while token:
            nusc.box_velocity(token)
            count, token = count + 1, nusc.get("sample_annotation", token)["next"]
        require(count == instance["nbr_annotations"], f"chain of instance {instance['token']}")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("dir")
    parser.add_argument("--version", default="v1.0-generated")
    args = parser.parse_args()
    nusc = NuScenes(version=args.version, dataroot=args.dir, verbose=False)
    check_chains(nusc)
    pictures, seen = check_pictures(nusc)
    require(seen > 0 or not nusc.sample_annotation, "no box lies in a picture")
    print(f"{len(nusc.scene)} scenes, {len(nusc.sample)} samples, {pictures} pictures, "
          f"{len(nusc.sample_annotation)} boxes of {len(nusc.instance)} objects, {seen} boxes in pictures")
    print("all checks passed")


if __name__ == "__main__":
    main()
