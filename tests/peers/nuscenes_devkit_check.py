"""Loads a folder in the nuScenes layout with the official devkit and checks what a user would rely on.

    python nuscenes_devkit_check.py DIR [--version v1.0-mini]

Prints one line per check and ends non-zero at the first failure. See README.md for how to make the environment.
"""

import argparse
import os
from collections import Counter, defaultdict

import numpy as np
from nuscenes.eval.common.loaders import load_gt
from nuscenes.eval.detection.data_classes import DetectionBox
from nuscenes.map_expansion import arcline_path_utils
from nuscenes.map_expansion.map_api import NuScenesMap
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.data_classes import LidarPointCloud
from nuscenes.utils.geometry_utils import BoxVisibility, points_in_box, view_points
from nuscenes.utils.splits import create_splits_scenes
from PIL import Image

# Room for rounding when corners of wholly visible boxes are asked to lie inside the picture.
PIXEL_TOLERANCE = 1e-6
# The format's readers expect a lane's path to end where it says it does.
LANE_END_TOLERANCE_M = 0.05
# Half the side of the map patches around the car.
PATCH_HALF_M = 20.0


def require(holds, text):
    if not holds:
        raise SystemExit(f"FAILED: {text}")


def report(what, text):
    print(f"{what:<22}{text}", flush=True)


def check_tokens(nusc):
    rows = 0
    for table in nusc.table_names:
        tokens = [row["token"] for row in getattr(nusc, table)]
        require(len(tokens) == len(set(tokens)), f"{table}: tokens repeat")
        rows += len(tokens)
        if table == "visibility":
            continue
        for token in tokens:
            require(len(token) == 32 and set(token) <= set("0123456789abcdef"), f"{table}: token {token}")
    report("tokens", f"{rows} rows in {len(nusc.table_names)} tables, unique, 32 hexadecimal digits")


def walk(nusc, table, first):
    """Tokens from `first` to the end of its chain; checks that every link goes both ways."""
    chain, before = [], ""
    token = first
    while token != "":
        row = nusc.get(table, token)
        require(row["prev"] == before, f"{table} {token}: prev is {row['prev']!r}, not {before!r}")
        chain.append(token)
        before, token = token, row["next"]
        require(len(chain) <= len(getattr(nusc, table)), f"{table}: the chain from {first} does not end")
    return chain


def check_chains(nusc):
    linked = 0
    for scene in nusc.scene:
        chain = walk(nusc, "sample", scene["first_sample_token"])
        require(chain[-1] == scene["last_sample_token"] and len(chain) == scene["nbr_samples"], scene["name"])
        stamps = [nusc.get("sample", token)["timestamp"] for token in chain]
        require(stamps == sorted(stamps), f"{scene['name']}: samples out of order")
        linked += len(chain)
    for instance in nusc.instance:
        chain = walk(nusc, "sample_annotation", instance["first_annotation_token"])
        require(chain[-1] == instance["last_annotation_token"], f"instance {instance['token']}")
        require(len(chain) == instance["nbr_annotations"], f"instance {instance['token']}")
        linked += len(chain)
    gaps = Counter()
    for first in (row for row in nusc.sample_data if row["prev"] == ""):
        chain = [nusc.get("sample_data", token) for token in walk(nusc, "sample_data", first["token"])]
        require(len({row["calibrated_sensor_token"] for row in chain}) == 1, f"{first['channel']}: mixed chain")
        for before, after in zip(chain, chain[1:]):
            require(before["timestamp"] < after["timestamp"], f"{first['channel']}: pictures out of order")
            if first["sensor_modality"] == "camera":
                gaps[round((after["timestamp"] - before["timestamp"]) / 50_000) * 50] += 1
        linked += len(chain)
    require(linked == len(nusc.sample) + len(nusc.sample_annotation) + len(nusc.sample_data), "rows outside all chains")
    spread = ", ".join(f"{gap} ms x {count}" for gap, count in sorted(gaps.items()))
    report("chains", f"{linked} rows linked both ways; gaps of camera pictures: {spread}")


def check_files(nusc):
    sizes = Counter()
    for row in nusc.sample_data:
        path = nusc.get_sample_data_path(row["token"])
        require(os.path.exists(path), f"missing {path}")
        require(row["filename"].startswith("samples/" if row["is_key_frame"] else "sweeps/"), row["filename"])
        if row["sensor_modality"] == "camera":
            with Image.open(path) as picture:
                picture.load()
                require(picture.size == (row["width"], row["height"]), f"{path} is {picture.size}")
                require(np.asarray(picture).std() > 1, f"{path} is blank")
                sizes[(picture.size, "key" if row["is_key_frame"] else "sweep")] += 1
    report("pictures", "; ".join(f"{n} {kind} {w}x{h}" for ((w, h), kind), n in sorted(sizes.items())))


def check_boxes(nusc):
    cameras = sorted(row["channel"] for row in nusc.sensor if row["modality"] == "camera")
    shown, whole, seen_somewhere = Counter(), 0, set()
    for sample in nusc.sample:
        require(sorted(c for c in sample["data"] if c in cameras) == cameras, f"sample {sample['token']}: cameras")
        require("LIDAR_TOP" in sample["data"], f"sample {sample['token']}: no lidar")
        for channel in cameras:
            token = sample["data"][channel]
            row = nusc.get("sample_data", token)
            _, boxes, intrinsic = nusc.get_sample_data(token, box_vis_level=BoxVisibility.ANY)
            shown[channel] += len(boxes)
            seen_somewhere.update(box.token for box in boxes)
            for box in nusc.get_sample_data(token, box_vis_level=BoxVisibility.ALL)[1]:
                corners = view_points(box.corners(), intrinsic, normalize=True)[:2]
                inside = (corners >= -PIXEL_TOLERANCE).all() and (corners[0] <= row["width"]).all()
                require(inside and (corners[1] <= row["height"]).all(), f"box {box.token} leaves {channel}")
                whole += 1
    # The devkit shows boxes by their corners: one that begins behind the camera, such as a passing bus, is in no picture.
    ahead = [row for row in nusc.sample_annotation if row["visibility_token"] == "4" and distance_m(nusc, row) > 10]
    lost = [row["token"] for row in ahead if row["token"] not in seen_somewhere]
    require(not lost, f"{len(lost)} of {len(ahead)} boxes said to be visible are in no picture: {lost[:1]}")
    total = f"{len(nusc.sample_annotation)} annotated; in pictures: {sum(shown.values())}, whole: {whole}"
    report("boxes", f"{total}; {dict(shown)}")
    names = {row["token"]: row["level"] for row in nusc.visibility}
    levels = Counter(names.get(row["visibility_token"], "not stated") for row in nusc.sample_annotation)
    report("visibility", ", ".join(f"{level}: {n}" for level, n in sorted(levels.items())))
    categories = Counter(row["category_name"] for row in nusc.sample_annotation)
    report("categories", ", ".join(f"{count} {name}" for name, count in categories.most_common()))


def distance_m(nusc, annotation):
    sample = nusc.get("sample", annotation["sample_token"])
    pose = nusc.get("ego_pose", nusc.get("sample_data", sample["data"]["LIDAR_TOP"])["ego_pose_token"])
    return np.linalg.norm(np.subtract(annotation["translation"], pose["translation"]))


def check_velocity(nusc):
    """Moving attributes agree with the devkit's velocities, except where an actor just starts or stops."""
    agree, asked = 0, 0
    for row in nusc.sample_annotation:
        velocity = nusc.box_velocity(row["token"])
        if np.isnan(velocity).any():
            continue
        require(np.linalg.norm(velocity) < 40, f"annotation {row['token']} moves at {velocity} m/s")
        names = [nusc.get("attribute", token)["name"] for token in row["attribute_tokens"]]
        for name in names:
            if name in ("vehicle.moving", "vehicle.parked", "pedestrian.moving", "pedestrian.standing"):
                asked += 1
                agree += (np.linalg.norm(velocity[:2]) > 0.2) == name.endswith("moving")
    require(asked == 0 or agree > 0.9 * asked, f"attributes fit velocities in {agree} of {asked} cases only")
    report("velocities", f"attributes fit the devkit's velocities in {agree} of {asked} cases")


def check_lidar(nusc):
    points, counted, enclosed = 0, 0, 0
    for sample in nusc.sample:
        path, boxes, _ = nusc.get_sample_data(sample["data"]["LIDAR_TOP"])
        cloud = LidarPointCloud.from_file(path)
        points += cloud.nbr_points()
        for box in boxes:
            count = nusc.get("sample_annotation", box.token)["num_lidar_pts"]
            counted += count
            if count:
                # A centimetre of room for points that lie exactly on a face.
                enclosed += min(count, int(points_in_box(box, cloud.points[:3], wlh_factor=1.02).sum()))
    require(counted == 0 or enclosed > 0.95 * counted, f"boxes enclose {enclosed} of {counted} counted points")
    report("lidar", f"{points} points; boxes enclose {enclosed} of the {counted} points counted for them")


def check_priors(nusc):
    poses = on_mask = 0
    for sample in nusc.sample:
        scene = nusc.get("scene", sample["scene_token"])
        mask = nusc.get("map", nusc.get("log", scene["log_token"])["map_token"])["mask"]
        x, y, z = nusc.get("ego_pose", sample["data"]["LIDAR_TOP"])["translation"]
        require(z == 0 and x > 0 and y > 0, f"car at {x}, {y}, {z}")
        poses += 1
        on_mask += bool(mask.is_on_mask(np.array([x]), np.array([y])).all())
    require(on_mask == poses, f"the semantic prior holds the car in {on_mask} of {poses} samples only")
    report("semantic prior", f"the car is on it in all {poses} samples")


def check_map(nusc, dataroot):
    by_location = defaultdict(list)
    for scene in nusc.scene:
        by_location[nusc.get("log", scene["log_token"])["location"]].append(scene["token"])
    for location, scenes in sorted(by_location.items()):
        city = NuScenesMap(dataroot=dataroot, map_name=location)
        counts = {layer: len(getattr(city, layer)) for layer in city.non_geometric_layers}
        report(location, f"v{city.version}, canvas {city.canvas_edge}, {counts}")
        invalid = [p["token"] for p in city.polygon if not city.extract_polygon(p["token"]).is_valid]
        require(not invalid, f"{location}: {len(invalid)} of {len(city.polygon)} polygons are not simple: {invalid[:1]}")
        poses = [
            nusc.get("ego_pose", sample["data"]["LIDAR_TOP"])
            for sample in nusc.sample
            if sample["scene_token"] in scenes
        ]
        share, lanes, distances = [], 0, []
        for pose in poses:
            x, y, _ = pose["translation"]
            patch = (x, y, 2 * PATCH_HALF_M, 2 * PATCH_HALF_M)
            masks = city.get_map_mask(patch, 0, ["drivable_area", "walkway", "lane"], (200, 200))
            require(masks[0][100, 100] == 1, f"{location}: no drivable area under the car at {x:.1f}, {y:.1f}")
            share.append(masks[0].mean())
            layers = city.layers_on_point(x, y)
            on_road = layers["drivable_area"] and layers["road_segment"]
            require(on_road, f"{location}: no road at {x:.1f}, {y:.1f}: {layers}")
            token = city.get_closest_lane(x, y, radius=4)
            require(token != "", f"{location}: no lane near {x:.1f}, {y:.1f}")
            lanes += 1
            path = np.array(arcline_path_utils.discretize_lane(city.arcline_path_3[token], 0.1))
            distances.append(np.linalg.norm(path[:, :2] - [x, y], axis=1).min())
        near = f"its middle {np.median(distances):.2f} m away (median), {max(distances):.2f} m at most"
        patches = f"{len(poses)} poses; drivable share of 40 m patches {np.mean(share):.2f}"
        report("  at the car", f"{patches}; lane found {lanes} times, {near}")
        check_lanes(city, location)


def check_lanes(city, location):
    worst_end, worst_joint, pieces = 0.0, 0.0, 0
    for token, path in city.arcline_path_3.items():
        require(len(path) > 0, f"{location}: lane {token} has no path")
        for piece in path:
            points = np.array(arcline_path_utils.discretize(piece, 0.1))
            worst_end = max(worst_end, np.linalg.norm(points[-1][:2] - piece["end_pose"][:2]))
            pieces += 1
        for link in city.get_outgoing_lane_ids(token):
            joint = np.subtract(city.arcline_path_3[link][0]["start_pose"][:2], path[-1]["end_pose"][:2])
            worst_joint = max(worst_joint, np.linalg.norm(joint))
            require(token in city.get_incoming_lane_ids(link), f"{location}: {token} -> {link} has no way back")
    require(worst_end <= LANE_END_TOLERANCE_M, f"{location}: a path ends {worst_end:.3f} m from its end pose")
    off = f"ends off by {worst_end:.4f} m at most, joints by {worst_joint:.4f} m"
    report("  lanes", f"{len(city.arcline_path_3)} paths of {pieces} pieces; {off}")


def check_splits(nusc, version):
    prefix = "mini_" if version.endswith("mini") else ""
    splits = create_splits_scenes()
    names = [scene["name"] for scene in nusc.scene]
    for split in (f"{prefix}train", f"{prefix}val"):
        chosen = [name for name in names if name in splits[split]]
        report(f"split {split}", f"{len(chosen)} scenes: {' '.join(chosen)}")
        if chosen:
            boxes = load_gt(nusc, split, DetectionBox, verbose=False)
            count = sum(len(found) for found in boxes.boxes.values())
            report("  detection truth", f"{count} boxes in {len(boxes.sample_tokens)} samples")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataroot")
    parser.add_argument("--version", default="v1.0-mini")
    arguments = parser.parse_args()
    nusc = NuScenes(version=arguments.version, dataroot=arguments.dataroot, verbose=False)
    check_tokens(nusc)
    check_chains(nusc)
    check_files(nusc)
    check_boxes(nusc)
    check_velocity(nusc)
    check_lidar(nusc)
    check_priors(nusc)
    check_map(nusc, arguments.dataroot)
    check_splits(nusc, arguments.version)
    print("all checks passed")


if __name__ == "__main__":
    main()
