"""Opens a split in the layout of Waymo's second release with pyarrow and checks what a user would rely on.

    python waymo_writer.py DIR [--split training]

Prints one line per check and ends non-zero at the first failure. See README.md for how to make the environment.
"""

import argparse
import hashlib
import io
import json
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from PIL import Image

CAMERAS = ["", "FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT", "REAR_LEFT", "REAR", "REAR_RIGHT"]
TYPES = ["UNKNOWN", "VEHICLE", "PEDESTRIAN", "SIGN", "CYCLIST"]
# Actors turn and brake between two frames.
SPEED_TOLERANCE = 1.0

KEY = {"key.segment_context_name": "string"}
FRAME = KEY | {"key.frame_timestamp_micros": "int64"}
TRANSFORM = "fixed_size_list<item: double>[16]"


def named(component, kinds):
    return {f"[{component}Component].{name}": kind for name, kind in kinds.items()}


# The published schema: names hold brackets and dots literally.
SCHEMA = {
    "camera_calibration": KEY
    | {"key.camera_name": "int8"}
    | named("CameraCalibration", {f"intrinsic.{n}": "double" for n in "f_u f_v c_u c_v k1 k2 p1 p2 k3".split()})
    | named(
        "CameraCalibration",
        {"extrinsic.transform": TRANSFORM, "width": "int32", "height": "int32", "rolling_shutter_direction": "int8"},
    ),
    "camera_image": FRAME
    | {"key.camera_name": "int8"}
    | named("CameraImage", {"image": "binary", "pose.transform": TRANSFORM, "pose_timestamp": "double"})
    | named("CameraImage", {f"velocity.linear_velocity.{axis}": "float" for axis in "xyz"})
    | named("CameraImage", {f"velocity.angular_velocity.{axis}": "double" for axis in "xyz"})
    | named(
        "CameraImage",
        {
            f"rolling_shutter_params.{name}": "double"
            for name in ("shutter", "camera_trigger_time", "camera_readout_done_time")
        },
    ),
    "vehicle_pose": FRAME | named("VehiclePose", {"world_from_vehicle.transform": TRANSFORM}),
    "lidar_box": FRAME
    | {"key.laser_object_id": "string"}
    | named("LiDARBox", {f"box.{part}.{axis}": "double" for part in ("center", "size") for axis in "xyz"})
    | named("LiDARBox", {f"{part}.{axis}": "double" for part in ("speed", "acceleration") for axis in "xyz"})
    | named(
        "LiDARBox",
        {
            "box.heading": "double",
            "type": "int8",
            "num_lidar_points_in_box": "int64",
            "num_top_lidar_points_in_box": "int64",
            "difficulty_level.detection": "int8",
            "difficulty_level.tracking": "int8",
        },
    ),
    "stats": FRAME | named("Stats", {name: "string" for name in ("time_of_day", "location", "weather")}),
}


def require(holds, text):
    if not holds:
        raise SystemExit(f"FAILED: {text}")


def report(what, text):
    print(f"{what:<18}{text}", flush=True)


def rows(split, component, context, columns=None):
    path = split / component / f"{context}.parquet"
    prefix = {name.split("].")[0] for name in SCHEMA[component] if name.startswith("[")}.pop() + "]."
    return [
        {name.removeprefix(prefix).removeprefix("key."): value for name, value in row.items()}
        for row in pq.read_table(path, columns=columns).to_pylist()
    ]


def matrix(numbers, where):
    pose = np.array(numbers).reshape(4, 4)
    require(np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9), f"{where}: no rotation")
    require(np.linalg.det(pose[:3, :3]) > 0 and (pose[3] == [0, 0, 0, 1]).all(), f"{where}: no pose")
    return pose


def check_schema(split):
    contexts = sorted(path.stem for path in (split / "camera_image").iterdir())
    tables = Counter()
    for component in SCHEMA:
        for path in sorted((split / component).iterdir()):
            require(path.stem in contexts, f"{path}: no pictures of this segment")
            schema = pq.read_schema(path)
            # Writers differ in the name of what a list holds.
            found = {field.name: str(field.type).replace("<element:", "<item:") for field in schema}
            require(found == SCHEMA[component], f"{path}: {set(found.items()) ^ set(SCHEMA[component].items())}")
            names = pq.read_table(path, columns=["key.segment_context_name"]).column(0).unique().to_pylist()
            require(names in ([path.stem], []), f"{path} holds rows of {names}")
            tables[component] += 1
    columns = sum(len(SCHEMA[component]) for component in tables)
    report("schema", f"{len(contexts)} segments, {sum(tables.values())} tables, {columns} columns by name and type")
    return contexts


def check_poses(split, contexts):
    poses, gaps = {}, []
    for context in contexts:
        table = rows(split, "vehicle_pose", context)
        stamps = [row["frame_timestamp_micros"] for row in table]
        require(stamps == sorted(set(stamps)), f"{context}: stamps out of order")
        gaps += np.diff(stamps).tolist()
        for row, stamp in zip(table, stamps):
            poses[context, stamp] = matrix(row["world_from_vehicle.transform"], f"{context} {stamp}")
    report("poses", f"{len(poses)} rotations with a shift; frames {min(gaps) / 1e3:.1f} to {max(gaps) / 1e3:.1f} ms apart")
    return poses


def check_calibration(split, contexts):
    cameras = {}
    for context in contexts:
        for row in rows(split, "camera_calibration", context):
            name = CAMERAS[row["camera_name"]]
            require((context, name) not in cameras, f"{context}: {name} twice")
            row["pose"] = matrix(row["extrinsic.transform"], f"{context} {name}")
            cameras[context, name] = row
        front = cameras[context, "FRONT"]["pose"]
        # In this format's camera axes x is forward.
        require(front[0, 0] > 0.99 and front[0, 3] > 0, f"{context}: FRONT looks along {front[:3, 0]}")
        left = cameras[context, "SIDE_LEFT"]["pose"]
        require(left[1, 0] > 0.99, f"{context}: SIDE_LEFT looks along {left[:3, 0]}")
    sizes = Counter((row["width"], row["height"]) for row in cameras.values())
    report("calibration", f"{len(cameras)} cameras; " + ", ".join(f"{n} of {w}x{h}" for (w, h), n in sorted(sizes.items())))
    return cameras


def check_pictures(split, contexts, poses, cameras):
    shots, groups = {}, 0
    for context in contexts:
        groups += pq.ParquetFile(split / "camera_image" / f"{context}.parquet").num_row_groups
        for row in rows(split, "camera_image", context):
            stamp, name = row["frame_timestamp_micros"], CAMERAS[row["camera_name"]]
            where = f"{context} {stamp} {name}"
            require((context, stamp) in poses, f"{where}: no such frame")
            require((context, stamp, name) not in shots, f"{where}: two pictures")
            camera = cameras[context, name]
            with Image.open(io.BytesIO(row["image"])) as picture:
                require(picture.format == "JPEG", f"{where} is {picture.format}")
                picture.load()
                require(picture.size == (camera["width"], camera["height"]), f"{where} is {picture.size}")
                require(np.asarray(picture).std() > 1, f"{where} is blank")
            late = row["pose_timestamp"] * 1e6 - stamp
            require(0 <= late <= 100_000, f"{where} was taken {late / 1e3} ms after its frame began")
            shots[context, stamp, name] = matrix(row["pose.transform"], where)
    report("pictures", f"{len(shots)} JPEG of their camera's size in {groups} row groups, each with its pose")
    return shots


def project(points, camera):
    """Pixels of points in this format's camera axes by OpenCV's formula; NaN behind the camera and beyond 40 degrees."""
    x, y, depth = -points[:, 1], -points[:, 2], points[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = np.where(depth > 0.5, [x / depth, y / depth], np.nan)
    square = x * x + y * y
    x, y, square = (np.where(square < 0.7, v, np.nan) for v in (x, y, square))
    k = {name: camera[f"intrinsic.{name}"] for name in "f_u f_v c_u c_v k1 k2 p1 p2 k3".split()}
    radial = 1 + square * (k["k1"] + square * (k["k2"] + square * k["k3"]))
    u = x * radial + 2 * k["p1"] * x * y + k["p2"] * (square + 2 * x * x)
    v = y * radial + k["p1"] * (square + 2 * y * y) + 2 * k["p2"] * x * y
    return np.stack([u * k["f_u"] + k["c_u"], v * k["f_v"] + k["c_v"]], 1)


def check_boxes(split, contexts, poses, cameras, shots):
    tracks, kinds, inside, total = defaultdict(dict), Counter(), Counter(), 0
    for context in contexts:
        frames = defaultdict(list)
        for row in rows(split, "lidar_box", context):
            stamp = row["frame_timestamp_micros"]
            require((context, stamp) in poses, f"{context} {stamp}: a box without a frame")
            center = np.array([row[f"box.center.{axis}"] for axis in "xyz"])
            size = np.array([row[f"box.size.{axis}"] for axis in "xyz"])
            require((size > 0).all() and abs(row["box.heading"]) <= np.pi, f"{context} {stamp}: {row}")
            kind = TYPES[row["type"]]
            require(kind != "VEHICLE" or size[0] > size[1], f"{context} {stamp}: a vehicle wider than long")
            kinds[kind] += 1
            total += 1
            world = (poses[context, stamp] @ [*center, 1])[:3]
            speed = np.array([np.nan if row[f"speed.{axis}"] is None else row[f"speed.{axis}"] for axis in "xyz"])
            tracks[context, row["laser_object_id"]][stamp] = (world, speed)
            frames[stamp].append(world)
        for stamp, centers in frames.items():
            for camera in CAMERAS[1:]:
                if (context, stamp, camera) in shots:
                    world_from_camera = shots[context, stamp, camera] @ cameras[context, camera]["pose"]
                    points = np.concatenate([centers, np.ones((len(centers), 1))], 1) @ np.linalg.inv(world_from_camera).T
                    size = [cameras[context, camera]["width"], cameras[context, camera]["height"]]
                    pixels = project(points[:, :3], cameras[context, camera])
                    inside[camera] += int(((pixels > 0) & (pixels < size)).all(1).sum())
    report("boxes", f"{total} of {len(tracks)} tracks; {dict(kinds.most_common())}")
    require(all(inside[name] > 0 for name in ("FRONT", "SIDE_LEFT", "SIDE_RIGHT")), f"centres in pictures: {inside}")
    report("centres", "in pictures: " + ", ".join(f"{name} {inside[name]}" for name in CAMERAS if inside[name]))
    check_speeds(tracks)


def check_speeds(tracks):
    """Speeds agree with the way a track goes in the world, so they stand in its axes."""
    asked, agree, moving = 0, 0, 0
    for track in tracks.values():
        stamps = sorted(track)
        for before, after in zip(stamps, stamps[1:]):
            seen = (track[after][0] - track[before][0])[:2] / ((after - before) * 1e-6)
            said = (track[before][1] + track[after][1])[:2] / 2
            if np.isfinite(said).all():
                asked += 1
                agree += np.linalg.norm(seen - said) < SPEED_TOLERANCE
                moving += np.linalg.norm(seen) > 2 * SPEED_TOLERANCE
    require(moving > 20 and agree > 0.97 * asked, f"speeds fit in {agree} of {asked} cases, {moving} of them moving")
    report("speeds", f"fit the tracks in the world in {agree} of {asked} cases, {moving} of them moving")


def check_manifest(root):
    manifest = json.loads((root / "manifest.json").read_text())
    for name, want in manifest["sha256"].items():
        require(hashlib.sha256((root / name).read_bytes()).hexdigest() == want, f"{name} is not what the manifest says")
    written = {str(path.relative_to(root)) for path in root.rglob("*.parquet")}
    require(written == set(manifest["sha256"]), f"not in the manifest: {written ^ set(manifest['sha256'])}")
    report("manifest", f"{len(written)} checksums hold; {manifest['tool']}, source {', '.join(manifest['source'])}")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--split", default="training")
    options = parser.parse_args()
    split = options.folder / options.split
    contexts = check_schema(split)
    poses = check_poses(split, contexts)
    cameras = check_calibration(split, contexts)
    shots = check_pictures(split, contexts, poses, cameras)
    check_boxes(split, contexts, poses, cameras, shots)
    check_manifest(options.folder)
    print("all checks passed")


if __name__ == "__main__":
    main()
